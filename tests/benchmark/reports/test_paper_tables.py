from __future__ import annotations

import csv
import io
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dummy_methods import CountMethod, FailingMethod, run
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.iqa.brisque import brisque
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.paper_files import to_csv, to_latex, to_markdown, write_table
from spike4dgs.benchmark.reports.paper_tables import (
    build_table,
    kendall_tau,
    published,
    ranks,
    table_columns,
    table_scenes,
    truth_scores,
)
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import open_scene


def test_published_numbers_are_the_papers() -> None:
    outdoor, objects = published(1), published(2)
    assert outdoor.worlds == ("jaywalk", "bicycle", "motor", "car", "van")
    assert objects.worlds == ("bricks", "chips", "turntable", "bird")
    assert len(outdoor.rows) == len(objects.rows) == 13 and set(outdoor.rows) == set(objects.rows)
    # A corner, the middle and the end of each table, read from the print.
    assert outdoor.rows["tfi+d3dgs"]["jaywalk"] == (20.65, 0.757, 0.384)
    assert outdoor.rows["spk2img+stg"]["motor"] == (24.70, 0.847, 0.223)
    assert outdoor.rows["dy-spikegs"]["van"] == (22.87, 0.851, 0.242)
    assert outdoor.rows["spike4dgs"]["van"] == (27.13, 0.901, 0.197)
    assert objects.rows["tfi+d3dgs"]["bricks"] == (57.35, 16.71, 0.114)
    assert objects.rows["spk2img+4dgs"]["bird"] == (34.02, 9.27, 0.149)
    assert objects.rows["spike4dgs"]["bird"] == (23.86, 8.36, 0.180)
    assert outdoor.mean("spike4dgs", "psnr") == pytest.approx((28.29 + 27.69 + 27.92 + 27.74 + 27.13) / 5)
    assert outdoor.value("nearest-view", "car", "psnr") is None and outdoor.mean("nearest-view", "psnr") is None
    for table in (outdoor, objects):
        assert all(set(r) == set(table.worlds) for name, r in table.rows.items() if name != "spike4dgs-x")
        assert all(0 < v[1] < 1 for r in outdoor.rows.values() for v in r.values()), "SSIM as a fraction"


def test_the_track_without_given_poses_has_a_row_for_every_row() -> None:
    for number in (1, 2):
        given, own = published(number), published(number, "estimated")
        assert (own.worlds, own.metrics) == (given.worlds, given.metrics)
        partners = {name.replace("+colmap", "").replace("-uncalibrated", "") for name in own.rows}
        assert partners == set(given.rows) and not set(own.rows) & set(given.rows)
        assert own.rows["tfp+colmap+4dgs"] == given.rows["tfp+4dgs"]
        assert own.rows["spike4dgs-uncalibrated"] == given.rows["spike4dgs"]
        assert own.rows["spike4dgs+colmap"] == own.rows["spike4dgs-x+colmap"] == {}, "one of ours is the paper's"


def test_tables_that_mix_poses_have_one_track() -> None:
    for number in (3, 4, 5, 7):
        with pytest.raises(UserError, match=f"--poses: expected given for table {number}, found estimated"):
            published(number, "estimated")
    with pytest.raises(UserError, match="--poses: expected one of given, estimated, found 'own'"):
        published(1, "own")


def test_rows_that_the_paper_prints_twice_are_named_in_the_note() -> None:
    table = published(2)
    for a, b in (("tfp+stg", "tfp+4dgs"), ("spk2img+stg", "spk2img+4dgs")):
        same = [w for w in table.worlds if table.rows[a][w] == table.rows[b][w]]
        assert same == ["chips", "turntable", "bird"]
        assert all(word in table.note for word in (a, b, *same))


@given(st.lists(st.one_of(st.none(), st.integers(0, 5).map(float)), max_size=8), st.sampled_from(["psnr", "niqe"]))
def test_ranks_count_the_better_values(values: list[float | None], name: str) -> None:
    metric = METRICS[name]
    for value, rank in zip(values, ranks(values, metric), strict=True):
        if value is None:
            assert rank is None
        else:
            better = [v for v in values if v is not None and (v > value if metric.higher_is_better else v < value)]
            assert rank == 1 + len(better)


@settings(deadline=None)  # the first call imports scipy.stats
@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=2, max_size=7))
def test_agreement_is_kendalls_tau_b(pairs: list[tuple[int, int]]) -> None:
    rows = [{"mean": {"psnr": {"value": a, "published": b}}} for a, b in pairs]
    score = ties_a = ties_b = 0
    couples = list(itertools.combinations(pairs, 2))
    for (a, b), (c, d) in couples:
        x, y = (a > c) - (a < c), (b > d) - (b < d)
        score, ties_a, ties_b = score + x * y, ties_a + (x == 0), ties_b + (y == 0)
    norm = ((len(couples) - ties_a) * (len(couples) - ties_b)) ** 0.5
    found = kendall_tau(rows, "psnr")
    assert found is None if norm == 0 else found == pytest.approx(score / norm)
    assert kendall_tau([{"mean": {"psnr": {"value": None, "published": 1.0}}}] * 3, "psnr") is None


@pytest.fixture
def table(small_scene: Path, tmp_path: Path) -> dict[str, Any]:
    """Two rows of table 1 on one scene that stands for the car, one of them failed, and a method of our own."""
    methods = (CountMethod("tfi+4dgs"), FailingMethod("dy-spikenerf", ValueError("no rays")), CountMethod("mine"))
    records = run(tmp_path / "out", [small_scene], *methods)
    return build_table(published(1), records, {scene: "car" for scene in records[0]["scenes"]})


def test_every_cell_is_a_number_or_a_reason(table: dict[str, Any]) -> None:
    for row in table["rows"]:
        for cell in row["scenes"].values():
            assert set(cell["values"]) == set(table_columns(published(1)))
            for value in cell["values"].values():
                assert (value["value"] is None) == (value["reason"] is not None)
    rows = {r["method"]: r for r in table["rows"]}
    (cell,) = rows["dy-spikenerf"]["scenes"].values()
    assert "no rays" in cell["values"]["psnr"]["reason"]
    (cell,) = rows["tfi+4dgs"]["scenes"].values()
    assert cell["values"]["psnr"]["published"] == 25.38
    assert rows["mine"]["mean"]["psnr"]["published"] is None
    assert rows["dy-spikenerf"]["mean"]["psnr"]["rank"] is None
    assert rows["tfi+4dgs"]["mean"]["psnr"] | {"value": 0} == {
        "value": 0,
        "published": pytest.approx(26.002),
        "rank": 1,
        "published_rank": 1,
    }


def test_refined_rows_take_no_rank_from_others(small_scene: Path, tmp_path: Path) -> None:
    methods = (CountMethod("tfi+4dgs"), CountMethod("tfi+4dgs.refined"), CountMethod("tfp+4dgs"))
    records = run(tmp_path / "out", [small_scene], *methods)
    table = build_table(published(1), records, {scene: "car" for scene in records[0]["scenes"]})
    found = {row["method"]: row["mean"]["psnr"]["rank"] for row in table["rows"]}
    assert found == {"tfi+4dgs": 1, "tfi+4dgs.refined": None, "tfp+4dgs": 1}, "the same images share a rank"
    last = {**records[2], "mean": {**records[2]["mean"], "psnr": records[2]["mean"]["psnr"] - 1}}
    rows = build_table(published(1), [*records[:2], last], {scene: "car" for scene in last["scenes"]})["rows"]
    assert rows[2]["mean"]["psnr"]["rank"] == 2


def test_files_say_the_same(table: dict[str, Any], tmp_path: Path) -> None:
    write_table(tmp_path, table)
    assert json.loads((tmp_path / "table.json").read_text())["rows"] == json.loads(json.dumps(table["rows"]))
    lines = list(csv.DictReader(io.StringIO(to_csv(table))))
    assert len(lines) == 3 * len(table["scenes"]) * len(table["metrics"])
    psnr = {r["method"]: r for r in lines if r["metric"] == "psnr"}
    assert psnr["dy-spikenerf"]["value"] == "" and "no rays" in psnr["dy-spikenerf"]["reason"]
    assert psnr["tfi+4dgs"]["published"] == "25.38"
    (scene,) = table["scenes"]
    value = table["rows"][0]["scenes"][scene]["values"]["psnr"]["value"]
    assert float(psnr["tfi+4dgs"]["value"]) == pytest.approx(value, rel=1e-5)
    markdown = to_markdown(table)
    blocks = [block.splitlines() for block in markdown.split("## ")[1:]]
    for block in blocks:
        widths = {line.count("|") for line in block if line.startswith("|")}
        assert len(widths) <= 1, "every line of a block has the same number of cells"
    assert "no rays" in markdown
    assert (tmp_path / "table.md").read_text() == markdown


def test_best_and_second_are_marked() -> None:
    def row(method: str, psnr: float | None, niqe: float) -> dict[str, Any]:
        def cell(v: float | None) -> dict[str, Any]:
            return {"value": v, "published": None, "reason": None if v is not None else "not run"}

        values = {"psnr": cell(psnr), "niqe": cell(niqe)}
        mean = {m: {**c, "rank": None, "published_rank": None} for m, c in values.items()}
        costs = dict.fromkeys(("fit_seconds", "render_fps", "peak_memory_mb", "model_mb"))
        return {"method": method, "scenes": {"s": {"status": "ok", "values": values, **costs}}, "mean": mean} | {
            "costs": costs
        }

    table = {
        "table": 1,
        "truth": {"s": {"niqe": 4.5}},
        "title": "T",
        "published_note": "n",
        "scenes": {"s": "car"},
        "metrics": [{"id": "psnr", "title": "PSNR"}, {"id": "niqe", "title": "NIQE"}],
        "agreement": {},
        "rows": [row("a", 20.0, 5.0), row("b", 30.0, 4.0), row("c", 25.0, 9.0), row("d", None, 6.0)],
    }
    lines = to_markdown(table).split("## PSNR")[0].splitlines()
    shown = {line.split(" | ")[0].strip("| "): line for line in lines if line.startswith(("| a", "| b", "| c", "| d"))}
    assert shown["b"].count("**") == 4 and "<u>" not in shown["b"], "b has the most PSNR and the least NIQE"
    assert "<u>5" in shown["a"] and "**" not in shown["a"] and "<u>25.00</u> | 9" in shown["c"]
    assert shown["d"].startswith("| d | - | 6")
    psnr_block = to_markdown(table).split("## PSNR")[1].split("##")[0]
    assert "| b | **30.00** |" in psnr_block and "| c | <u>25.00</u> |" in psnr_block
    niqe_block = to_markdown(table).split("## NIQE")[1]
    assert "| ground truth | 4.500 |" in niqe_block and "ground truth" not in psnr_block
    latex = to_latex(table)
    assert r"b & \textbf{30.00}" in latex and r"c & \underline{25.00}" in latex and latex.count(r"\begin{tabular}") == 3


def test_the_truth_has_scores_by_the_metrics_that_ask_for_none(small_scene: Path) -> None:
    scene = open_scene(small_scene)
    found = truth_scores(scene, [METRICS["psnr"], METRICS["brisque"]])
    values = [brisque(encode_srgb(np.clip(scene.ground_truth(t), 0, 1)), "truth") for t in scene.targets]
    assert found == {"brisque": pytest.approx(np.mean(values))}
    assert truth_scores(scene, [METRICS["psnr"]]) == {}


def test_missing_scenes_name_the_command_that_makes_them(tmp_path: Path) -> None:
    (tmp_path / "car-0-small").mkdir()
    with pytest.raises(UserError, match=r"no jaywalk-0-small, .*make-dataset jaywalk bicycle motor car van --profile"):
        table_scenes(published(1), tmp_path, "small")
    with pytest.raises(UserError, match=r"--table: expected 1 \(.*7 \(.*6 \(.*found 8"):
        published(8)
