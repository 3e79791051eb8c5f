"""Result records as a DataFrame: one row per method and scene, or per image."""

import sys
from pathlib import Path
from typing import Any

import pytest
from dummy_methods import CountMethod, FailingMethod, run

from spike4dgs.benchmark import METRICS, UserError, records_to_dataframe
from spike4dgs.benchmark.runs.record import COSTS

pytest.importorskip("pandas")


@pytest.fixture
def records(small_scene: Path, tmp_path: Path) -> list[dict[str, Any]]:
    methods = (CountMethod("counts"), FailingMethod("bad", ValueError("no luck")))
    return run(tmp_path / "out", [small_scene], *methods, seed=3)


def test_a_row_is_a_method_on_a_scene(records: list[dict[str, Any]], tmp_path: Path) -> None:
    frame = records_to_dataframe(*records)
    rows = [[name, 3, "pattern-0", "center", status] for name, status in (("counts", "ok"), ("bad", "failed"))]
    assert frame[["method", "seed", "scene", "split", "status"]].values.tolist() == rows
    assert [c for c in frame.columns if c in METRICS or c in COSTS] == [*METRICS, *COSTS]
    assert frame["psnr"][0] == records[0]["scenes"]["pattern-0"]["metrics"]["psnr"]
    assert frame["psnr"].isna().tolist() == [False, True] and "no luck" in frame["error"][1]
    assert {str(kind) for kind in frame.dtypes[list(METRICS)]} == {"float64"}
    assert records_to_dataframe(tmp_path / "out/results/counts.json").equals(records_to_dataframe(records[0]))
    assert records_to_dataframe().empty


def test_a_row_may_be_an_image(records: list[dict[str, Any]]) -> None:
    frame = records_to_dataframe(*records, per_image=True)
    per_image = records[0]["scenes"]["pattern-0"]["per_image"]
    assert frame[["method", "camera", "tick"]].values.tolist() == [["counts", "cam_03", t] for t in (20, 40, 60)]
    assert frame["ssim"].tolist() == [per_image[f"cam_03/0000{t}"]["ssim"] for t in (20, 40, 60)]
    assert "fit_seconds" not in frame


def test_without_pandas_one_line_says_so(records: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(UserError, match=r"the package pandas, found none; pip install 'spike4dgs\[pandas\]'"):
        records_to_dataframe(*records)
