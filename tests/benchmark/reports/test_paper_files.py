"""The tables of the ablations: what the paper prints, which methods they name, and the one that compares splits."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from dummy_methods import CountMethod, FailingMethod
from PIL import Image
from run_command import run_benchmark
from small_scenes import write_small_scene

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import find_methods
from spike4dgs.benchmark.reports.paper_tables import published
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.cli import run_benchmark as run_command

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


@pytest.mark.parametrize("number", [None, 6, 4])
def test_a_track_belongs_to_tables_1_and_2(number: int | None, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--poses: expected (--table 1 or 2 beside it|given for table 4)"):
        run_benchmark(table=number, poses="estimated", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def seen_as(scene: Scene, split: str) -> Scene:
    """The scene, with its split views-3 under another name."""
    return replace(
        scene,
        meta=scene.meta | {"splits": scene.meta["splits"] | {split: scene.meta["splits"]["views-3"]}},
        split=split,
    )


def test_a_table_over_splits_runs_each_and_puts_them_side_by_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, out = write_small_scene(tmp_path / "scene", splits=True), tmp_path / "out"
    scenes = {name: seen_as(open_scene(path), name) for name in ("views-3", "views-4")}
    table = replace(published(5), splits=tuple(scenes))
    methods = {"tfi+4dgs": CountMethod("tfi+4dgs"), "tfi+stg": FailingMethod("tfi+stg", ValueError("no views"))}
    monkeypatch.setattr(run_command, "published", lambda number, track: table)
    monkeypatch.setattr(run_command, "table_scenes", lambda table, data, profile: (path,))
    monkeypatch.setattr(run_command, "find_methods", lambda: methods)
    monkeypatch.setattr(run_command, "submit_all", lambda results, **options: 0)
    monkeypatch.setattr(run_command, "open_scenes", lambda paths, gaps, split: [scenes[split]])
    assert run_benchmark(table=5, out=out, device="cpu", metrics=("psnr",)) == 1, "one method fails"
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
