"""The ladder's table: what each rung gains, from the records alone."""

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from dummy_methods import CountMethod, FailingMethod
from PIL import Image
from rich.console import Console
from small_scenes import write_small_scene

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import Budget, Progress
from spike4dgs.benchmark.runs.run import Settings
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.studies.oracle_ladder import climb, make_table, to_markdown, write_ladder
from spike4dgs.studies.oracle_methods import Ladder, Rung
from spike4dgs.studies.oracle_truth import Truth


class Marks:
    """A truth of no content: it writes which ticks it was asked for."""

    def __init__(self, scene: Scene) -> None:
        if scene.id == "pattern-9":
            raise UserError("pattern-9 was not generated here")

    def write(self, truth: Truth, ticks: Sequence[int], samples: int, progress: Progress) -> None:
        truth.folder.mkdir(parents=True, exist_ok=True)
        (truth.folder / "ticks").write_text(f"{list(ticks)} {samples}")


def oracle(name: str, steps: int) -> CountMethod:
    method = CountMethod(name, steps=steps)
    method.oracle = ("steps",)  # type: ignore[attr-defined]
    return method


def go(scenes: list[Path], out: Path, *rungs: CountMethod, **settings: object) -> list[dict[str, object]]:
    ladder = Ladder("counts", tuple(Rung(f"rung of {m.name}", m) for m in rungs), lambda n: range(0, n, 40), ("x: y",))
    opened = [open_scene(s) for s in scenes]
    console = Console(file=io.StringIO(), width=200)
    records = climb(opened, [ladder], Marks, out / "truth", 32, Settings(out, metrics=("psnr",), **settings), console)  # type: ignore[arg-type]
    assert "counts: left out: x: y" in console.file.getvalue()  # type: ignore[attr-defined]
    return records


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("scenes")
    return [write_small_scene(folder / f"s{i}", seed=i) for i in range(2)]


def test_the_table_has_what_the_records_have_and_the_difference_to_the_first_rung(scenes: list[Path], tmp_path) -> None:
    out = tmp_path / "out"
    records = go(scenes, out, CountMethod("counts", steps=1), oracle("counts+oracle-steps", 9))
    rows = list(csv.DictReader((out / "ladder.csv").read_text().splitlines()))
    assert [(r["rung"], r["scene"]) for r in rows] == [
        (f"rung of {m}", s) for m in ("counts", "counts+oracle-steps") for s in ("pattern-0", "pattern-1", "mean")
    ]
    for row, (record, scene) in zip(rows, [(r, s) for r in records for s in (*r["scenes"], "mean")], strict=True):
        for metric in ("psnr", "psnr_dynamic"):
            of = lambda r: r["mean"] if scene == "mean" else r["scenes"][scene]["metrics"]  # noqa: B023, E731
            assert float(row[metric]) == pytest.approx(of(record)[metric], abs=1e-3)
            assert float(row[f"{metric}_gain"]) == pytest.approx(of(record)[metric] - of(records[0])[metric], abs=1e-3)
    text = (out / "ladder.md").read_text()
    last = rows[-1]
    assert f"{float(last['psnr']):.2f} ({float(last['psnr_gain']):+.2f}) |" in text
    with Image.open(out / "ladder_counts.png") as image:
        assert min(image.size) > 200 and np.asarray(image.convert("L")).std() > 10
    folders = sorted(p.name for p in (out / "truth").iterdir())
    revisions = [open_scene(s).revision[:12] for s in scenes]
    assert folders == sorted(f"pattern-{i}@{r}-32" for i, r in enumerate(revisions))
    assert all((out / "truth" / f / "ticks").read_text() == "[0, 40] 32" for f in folders)
    marks = [json.loads(p.read_text())["method"].get("oracle") for p in sorted((out / "results").glob("*.json"))]
    assert marks == [["steps"], None] or marks == [None, ["steps"]]


def test_finished_rungs_are_kept(scenes: list[Path], tmp_path: Path) -> None:
    first, second = CountMethod("counts"), oracle("counts+oracle-steps", 2)
    go(scenes, tmp_path / "out", first, second)
    before = (tmp_path / "out/ladder.csv").read_text()
    assert (first.fits, second.fits) == (2, 2)
    go(scenes, tmp_path / "out", first, second)
    assert (first.fits, second.fits) == (2, 2) and (tmp_path / "out/ladder.csv").read_text() == before


def test_a_rung_that_fails_is_a_dash_with_its_reason(scenes: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    go(scenes[:1], out, CountMethod("counts"), FailingMethod("bad", ValueError("no luck")))
    text = (out / "ladder.md").read_text()
    assert "| rung of bad | - |" in text and "ValueError: no luck" in text
    row = list(csv.DictReader((out / "ladder.csv").read_text().splitlines()))[-1]
    assert (row["psnr"], row["psnr_gain"]) == ("", "") and "no luck" in row["error"]


def test_a_scene_without_truth_is_refused_before_any_work(scenes: list[Path], tmp_path: Path) -> None:
    strange, method = write_small_scene(tmp_path / "s9", seed=9), CountMethod("counts")
    with pytest.raises(UserError, match="pattern-9 was not generated here"):
        go([*scenes, strange], tmp_path / "out", method)
    assert method.fits == 0 and not (tmp_path / "out").exists()


def test_the_budget_of_a_publication_has_no_four_times_the_steps(scenes: list[Path], tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--budget: expected quick, standard or a multiple, found paper"):
        go(scenes, tmp_path / "out", CountMethod("counts"), budget=Budget(published=True))


def record(name: str, seed: int, psnr: float, seconds: float) -> dict[str, object]:
    metrics = {"psnr": psnr, "psnr_dynamic": psnr - 4}
    cell = {"status": "ok", "error": None, "metrics": metrics, "fit_seconds": seconds}
    return {"method": {"name": name, "seed": seed}, "scenes": {"a": cell}}


def test_cells_are_means_over_the_seeds(tmp_path: Path) -> None:
    records = [record("m", 0, 30, 10), record("m", 1, 32, 20), record("o", 0, 35, 5), record("o", 1, 36, 6)]
    rungs = (Rung("as it is", CountMethod("m")), Rung("more", CountMethod("o")))
    table = make_table(Ladder("m", rungs, range), ["a"], records)
    assert table.rungs["as it is"]["a"] == {"psnr": 31, "psnr_dynamic": 27, "fit_seconds": 15}
    assert table.gain("more", "a", "psnr") == pytest.approx(4.5) and table.places == ("a",)
    assert "| more | 35.50 (+4.50) |" in to_markdown(table) and "| as it is | 31.00 |" in to_markdown(table)
    write_ladder(tmp_path, [table])
    assert "m,more,a,35.5000,31.5000,5.5000,4.5000,4.5000," in (tmp_path / "ladder.csv").read_text()
