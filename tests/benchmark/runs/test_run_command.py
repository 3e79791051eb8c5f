"""`run-benchmark`, as the command line calls it."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from dummy_methods import CountMethod, FailingMethod
from PIL import Image

from spike4dgs.benchmark import method as recipes
from spike4dgs.benchmark.cli import load
from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.errors import UserError
from spike4dgs.leaderboard.entry import read_entry

run_benchmark = load("run-benchmark")


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two methods and a failing one, found as those of another package are: by entry point."""
    methods = {m.name: m for m in (CountMethod("counts"), CountMethod("quick+counts", steps=1))}
    methods["bad"] = FailingMethod("bad", ValueError("no luck"))
    entry = SimpleNamespace(name="theirs", value="theirs:METHODS", dist=None, load=lambda: methods)
    monkeypatch.setattr(recipes, "entry_points", lambda group: [entry])


@pytest.mark.usefixtures("installed")
def test_run_benchmark_leaves_results_images_and_entries(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    code = run_benchmark((small_scene,), methods=("counts", "quick+counts"), out=out, device="cpu", budget="0.5")
    assert code == 0
    text = capsys.readouterr().out
    assert "quick+counts" in text and "Results" in text and "verified, rank 1 of" in text
    for name in ("sheet_pattern-0.png", "scatter.png"):
        with Image.open(out / name) as image:
            assert min(image.size) > 300
    assert read_entry(out / "leaderboard/entries/pattern-0/quick+counts.json")["label"] == "verified"
    rows = json.loads((out / "leaderboard/leaderboard.json").read_text())["boards"][0]["rows"]
    assert [r["rank"] for r in rows] == [1, 2]
    record = json.loads((out / "results/counts.json").read_text())
    assert record["scenes"]["pattern-0"]["budget"] == 0.5


@pytest.mark.usefixtures("installed")
def test_run_benchmark_exits_1_where_a_cell_failed(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run_benchmark((small_scene,), methods=("bad", "quick+counts"), out=out, device="cpu") == 1
    shown = capsys.readouterr()
    assert "failed: bad on pattern-0" in shown.err
    assert "bad (failed)" in shown.out
    rows = json.loads((out / "leaderboard/leaderboard.json").read_text())["boards"][0]["rows"]
    assert [(r["method"], r["rank"]) for r in rows] == [("quick+counts", 1), ("bad", None)]


@pytest.mark.usefixtures("installed")
def test_another_record_in_a_shared_leaderboard_needs_replace(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def go(seed: int, replace: bool = False) -> int:
        return run_benchmark(
            (small_scene,),
            methods=("quick+counts",),
            out=tmp_path / "out",
            seed=seed,
            device="cpu",
            leaderboard=tmp_path / "board",
            replace=replace,
        )

    assert go(0) == 0 and go(0) == 0
    assert go(1) == 1
    assert "pass --replace" in capsys.readouterr().err
    assert go(1, replace=True) == 0
    assert read_entry(tmp_path / "board/entries/pattern-0/quick+counts.json")["record"]["method"]["seed"] == 1


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"methods": ("nonsense",)}, "--methods: expected names among bad, counts, quick+counts, found nonsense"),
        ({"budget": "0"}, "--budget: expected quick, standard, paper, or a positive number, found '0'"),
        ({"budget": "nan"}, "or a positive number, found 'nan'"),
        ({"budget": "fast"}, "or a positive number, found 'fast'"),
        ({"device": "tpu"}, "--device: expected auto, cpu or cuda, found 'tpu'"),
        ({"device": "cuda:99"}, "--device: expected a CUDA device of this machine, found 'cuda:99'"),
        ({"scenes": ()}, "scenes: expected at least one scene folder"),
        ({"scenes": (Path("nowhere"),)}, "nowhere: expected a scene folder, found no such folder"),
    ],
)
def test_bad_arguments_are_user_errors(
    small_scene: Path, tmp_path: Path, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError) as e:
        run_benchmark(**{"scenes": (small_scene,), "out": tmp_path / "out", **arguments})
    assert message in str(e.value)
    assert not (tmp_path / "out").exists()


def test_without_a_gpu_auto_is_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_device("auto") == "cpu" == choose_device("cpu")
