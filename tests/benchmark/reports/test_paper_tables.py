import csv
import io
import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dummy_methods import CountMethod, FailingMethod, run
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from run_command import run_benchmark
from small_scenes import write_small_scene

from spike4dgs.benchmark import METRICS, Scene, UserError, find_methods, open_scene
from spike4dgs.benchmark.metrics.iqa.brisque import brisque
from spike4dgs.benchmark.reports.console import blocks_of
from spike4dgs.benchmark.reports.paper_files import to_csv, to_latex, to_markdown, write_table
from spike4dgs.benchmark.reports.paper_tables import (
    build_table,
    kendall_tau,
    over_seeds,
    published,
    ranks,
    table_columns,
    table_scenes,
    truth_scores,
)
from spike4dgs.benchmark.runs.record import COSTS
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.cli import run_benchmark as run_command


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


@pytest.fixture(scope="module")
def table(one_small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Two rows of table 1 on one scene that stands for the car, one of them failed, and a method of our own."""
    methods = (CountMethod("tfi+4dgs"), FailingMethod("dy-spikenerf", ValueError("no rays")), CountMethod("mine"))
    records = run(tmp_path_factory.mktemp("table") / "out", [one_small_scene], *methods)
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
    mean = {"published": pytest.approx(26.002), "rank": 1, "published_rank": 1}
    assert rows["tfi+4dgs"]["mean"]["psnr"].items() >= mean.items()


def test_refined_rows_take_no_rank_from_others(small_scene: Path, tmp_path: Path) -> None:
    methods = (CountMethod("tfi+4dgs"), CountMethod("tfi+4dgs.refined"), CountMethod("tfp+4dgs"))
    records = run(tmp_path / "out", [small_scene], *methods)
    table = build_table(published(1), records, {scene: "car" for scene in records[0]["scenes"]})
    found = {row["method"]: row["mean"]["psnr"]["rank"] for row in table["rows"]}
    assert found == {"tfi+4dgs": 1, "tfi+4dgs.refined": None, "tfp+4dgs": 1}, "the same images share a rank"
    last = {**records[2], "mean": {**records[2]["mean"], "psnr": records[2]["mean"]["psnr"] - 1}}
    rows = build_table(published(1), [*records[:2], last], {scene: "car" for scene in last["scenes"]})["rows"]
    assert rows[2]["mean"]["psnr"]["rank"] == 2


def test_refined_rows_have_no_mark(small_scene: Path, tmp_path: Path) -> None:
    """As they have no rank: the best row that has one is marked."""
    records = run(tmp_path / "out", [small_scene], CountMethod("tfi+4dgs"), CountMethod("tfi+4dgs.refined"))
    better = {**records[1], "mean": {**records[1]["mean"], "psnr": records[0]["mean"]["psnr"] + 1}}
    content = build_table(published(1), [records[0], better], {scene: "car" for scene in better["scenes"]})
    lines = {line.split(" | ")[0]: line for line in to_markdown(content).split("## ")[1].splitlines()}
    assert "**" in lines["| tfi+4dgs"] and "**" not in lines["| tfi+4dgs.refined"] and "<u>" not in "".join(lines)
    _, _, blocks = blocks_of([records[0], better, {**records[0], "method": records[0]["method"] | {"name": "other"}}])
    bold = {name: any(best for _, best in values) for name, values in blocks[-1].rows}
    assert bold == {"tfi+4dgs": True, "tfi+4dgs.refined": False, "other": True}


def test_costs_of_a_row_with_a_failed_scene_are_no_means_of_the_others(table: dict[str, Any]) -> None:
    rows = {row["method"]: row for row in table["rows"]}
    assert rows["tfi+4dgs"]["costs"]["fit_seconds"] is not None
    cell = {"metrics": dict.fromkeys(METRICS), "notes": {}, "error": "e", "status": "ok", **dict.fromkeys(COSTS, 40.0)}
    failed = {**cell, "status": "failed", **dict.fromkeys(COSTS)}
    record = {"method": {"name": "tfi+4dgs"}, "scenes": {"a": cell, "b": failed}, "mean": dict.fromkeys(METRICS)}
    record |= {"dataset": {}, "harness": {}, "environment": {}}
    content = build_table(published(1), [record], {"a": "car", "b": "van"})
    assert content["rows"][0]["costs"] == dict.fromkeys(COSTS)


def test_a_table_of_several_seeds_has_their_means(small_scene: Path, tmp_path: Path) -> None:
    (record,) = run(tmp_path / "out", [small_scene], CountMethod("tfi+4dgs"))
    (scene,) = record["scenes"]

    def with_seed(seed: int, psnr: float | None, status: str = "ok") -> dict[str, Any]:
        cell = {**record["scenes"][scene], "status": status, "fit_seconds": 10.0 * seed}
        cell["metrics"] = {**cell["metrics"], "psnr": psnr}
        mean = {**record["mean"], "psnr": psnr}
        return {**record, "method": {**record["method"], "seed": seed}, "scenes": {scene: cell}, "mean": mean}

    (found,) = over_seeds([with_seed(0, 30.0), with_seed(1, 34.0), with_seed(2, 35.0)])
    assert found["mean"]["psnr"] == found["scenes"][scene]["metrics"]["psnr"] == 33.0
    assert found["scenes"][scene]["fit_seconds"] == 10.0
    assert found["mean"]["ssim"] == record["mean"]["ssim"]
    (found,) = over_seeds([with_seed(0, 30.0), with_seed(1, None, "failed")])
    assert found["mean"]["psnr"] is None and found["scenes"][scene]["status"] == "failed"


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
        scenes = {"s": {"status": "ok", "values": values, **costs}}
        return {"method": method, "scenes": scenes, "mean": mean, "costs": costs}

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
    with pytest.raises(UserError, match=r"--table: expected 1 \(.*7 \(.*found 6; .*`spike4dgs speed images` makes"):
        published(6)


METHODS = find_methods()

VIEWS = tuple(f"views-{n}" for n in range(3, 9))


def test_published_ablations_are_the_papers() -> None:
    components, supervision, views, msdi = (published(n) for n in (3, 4, 5, 7))
    for table in (components, supervision, msdi):
        assert table.worlds == published(1).worlds and table.metrics == ("psnr", "ssim", "lpips_alex")
        assert table.rows["spike4dgs"]["mean"] == (27.74, 0.912, 0.190)
        assert table.value("spike4dgs", "car", "psnr") is None, "only means are printed"
        assert all(set(row) <= {"mean"} for row in table.rows.values())
    assert components.mean("tfi+colmap+4dgs", "psnr") == 21.08
    assert components.rows["tfi+dust3r+4dgs+spss"]["mean"] == (26.34, 0.902, 0.201)
    assert supervision.rows["msdi+4dgs+spike"]["mean"] == (13.79, 0.763, 0.408)
    assert supervision.rows["msdi+4dgs+pixel+spike"]["mean"] == (26.69, 0.895, 0.203)
    assert msdi.rows["msdi+colmap+4dgs"]["mean"] == (22.43, 0.854, 0.233)
    shared = set(components.rows) & set(msdi.rows)
    assert len(shared) == 4 and all(components.rows[m] == msdi.rows[m] for m in shared)
    assert views.worlds == ("turntable",) and views.splits == VIEWS and views.metrics == ("brisque", "niqe")
    assert views.value("tfi+d3dgs", "views-3", "brisque") == 83.4
    assert views.value("spike4dgs", "views-6", "niqe") == 11.67
    assert views.mean("tfi+stg", "niqe") == pytest.approx((22.8 + 17.5 + 16.7 + 14.6 + 13.1 + 10.53) / 6)
    for method in set(views.rows) - {"tfp+4dgs+spss"}:  # eight views are all but the held-out one
        assert views.rows[method]["views-8"] == published(2).rows[method]["turntable"][:2]


@pytest.mark.parametrize("number", [3, 4, 5, 7])
def test_rows_without_msdi_are_methods_and_rows_of_ours_have_no_published_values(number: int) -> None:
    table = published(number)
    for name, values in table.rows.items():
        assert name in METHODS or name == "spike4dgs" or name.startswith("msdi+")
        assert bool(values) or name.startswith("tfp+")
        assert values or table.mean(name, table.metrics[0]) is None


@pytest.mark.parametrize("number", [None, 4])
def test_a_track_belongs_to_tables_1_and_2(number: int | None, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--poses: expected (--table 1 or 2 beside it|given for table 4)"):
        run_benchmark(table=number, poses="estimated", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def seen_as(scene: Scene, split: str) -> Scene:
    """The scene, with its split views-3 under another name."""
    splits = scene.meta["splits"]
    return replace(scene, meta=scene.meta | {"splits": splits | {split: splits["views-3"]}}, split=split)


@pytest.mark.usefixtures("no_images")
def test_a_table_over_splits_runs_each_and_joins_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, out = write_small_scene(tmp_path / "scene", splits=True), tmp_path / "out"
    scenes = {name: seen_as(open_scene(path), name) for name in ("views-3", "views-4")}
    table = replace(published(5), splits=tuple(scenes))
    methods = {"tfi+4dgs": CountMethod("tfi+4dgs"), "tfi+stg": FailingMethod("tfi+stg", ValueError("no views"))}
    monkeypatch.setattr(run_command, "published", lambda number, track: table)
    monkeypatch.setattr(run_command, "table_scenes", lambda table, data, profile: (path,))
    monkeypatch.setattr(run_command, "find_methods", lambda: methods)
    monkeypatch.setattr(run_command, "submit_all", lambda results, **options: 0)
    monkeypatch.setattr(run_command, "open_scenes", lambda paths, gaps, split: [scenes[split]])
    assert run_benchmark(table=5, out=out, device="cpu", metrics=("psnr",), in_process=True) == 1, "one method fails"
    content = json.loads((out / "table.json").read_text())
    assert content["scenes"] == {"pattern-0, views-3": "views-3", "pattern-0, views-4": "views-4"}
    assert content["dataset"]["split"] == "views-3, views-4"
    rows = {row["method"]: row for row in content["rows"]}
    records = [json.loads((out / name / "results/tfi+4dgs.json").read_text()) for name in scenes]
    counted = [record["scenes"]["pattern-0"]["metrics"]["psnr"] for record in records]
    assert rows["tfi+4dgs"]["mean"]["psnr"]["value"] == pytest.approx(sum(counted) / 2)
    for (column, name), value in zip(content["scenes"].items(), (70.3, 60.8), strict=True):
        cell = rows["tfi+4dgs"]["scenes"][column]["values"]["brisque"]
        assert cell["published"] == value == published(5).value("tfi+4dgs", name, "brisque")
        assert "no views" in rows["tfi+stg"]["scenes"][column]["values"]["psnr"]["reason"]
    assert "views-3 | published | views-4 | published" in (out / "table.md").read_text()
    with Image.open(out / "views.png") as image:
        assert min(image.size) > 300
