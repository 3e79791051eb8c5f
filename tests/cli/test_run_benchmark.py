"""`run-benchmark`, as the command line calls it."""

import csv
import json
import re
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from changes import edit_json
from dummy_methods import CountMethod, FailingMethod
from nosy_methods import PlaysBack
from PIL import Image
from run_command import run_benchmark
from small_scenes import write_small_scene

from spike4dgs.benchmark import UserError, open_scene, plugins
from spike4dgs.benchmark.reports import benchmark
from spike4dgs.benchmark.reports.figure import save_figure
from spike4dgs.benchmark.reports.paper_tables import published
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.cli import main
from spike4dgs.cli import run_benchmark as command
from spike4dgs.leaderboard.page.rows import run_records

# fits in this process: to start one for each takes longer than the fit
run_here = partial(run_benchmark, in_process=True)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two methods, a failing one and one that cheats, found as those of another package are: by entry point."""
    methods = {m.name: m for m in (CountMethod("counts"), CountMethod("quick+counts", steps=1))}
    methods["bad"] = FailingMethod("bad", ValueError("no luck"))
    methods["plays-back"] = PlaysBack()
    entry = SimpleNamespace(name="theirs", value="theirs:METHODS", dist=None, load=lambda: methods)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])


@pytest.fixture
def brief(no_images: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither images nor, for the display, the times of all published fits: most of a small run."""
    monkeypatch.setattr(command, "typical_fit_seconds", dict)


@pytest.mark.usefixtures("installed")
def test_results_images_and_entries_stay(small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "my runs"
    assert run_here((small_scene,), methods=("counts", "quick+counts"), out=out, device="cpu", budget="0.5") == 0
    text = capsys.readouterr().out
    assert f"spike4dgs leaderboard --runs '{out}'" in text.replace("\n", " "), "a line to copy"
    assert "quick+counts" in text and "Results" in text and "re-scored, place 1 of 2 by mean PSNR" in text
    for name in ("sheet_pattern-0", "scatter"):
        with Image.open(out / f"{name}.png") as image:
            assert min(image.size) > 300
        assert (out / f"{name}.pdf").read_bytes().startswith(b"%PDF-")
    assert cv2.VideoCapture(str(out / "sheet_pattern-0.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 3, "one for each target"
    rows = json.loads((out / "leaderboard/local.json").read_text())["boards"][0]["rows"]
    assert [(r["rank"], r["label"]) for r in rows] == [(1, "re-scored"), (2, "re-scored")]
    assert text.count("local board, in") == 1, "one line says that no track has this scene"
    record = json.loads((out / "results/counts.json").read_text())
    assert record["scenes"]["pattern-0"]["budget"] == 0.5


@pytest.mark.usefixtures("installed", "brief")
def test_ranks_are_printed_once_and_are_the_final_ones_and_a_failed_cell_is_exit_1(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ("counts", "quick+counts", "bad")
    assert run_here((small_scene,), methods=names, out=tmp_path / "out", device="cpu", metrics=("psnr",)) == 1
    text, errors = capsys.readouterr()
    assert "failed: bad on pattern-0" in errors and "bad (failed)" in text
    shown = dict(re.findall(r"^(\S+): .*, (place \d of 2|not ranked) .*on the local board", text, re.MULTILINE))
    rows = json.loads((tmp_path / "out/leaderboard/local.json").read_text())["boards"][0]["rows"]
    assert shown == {r["method"]: f"place {r['rank']} of 2" if r["rank"] else "not ranked" for r in rows}
    assert text.index("results.csv") < text.index(", place ") and text.count(", place ") == 2
    assert [r["rank"] for r in rows] == [1, 2, None] and rows[2]["method"] == "bad"


@pytest.mark.usefixtures("installed")
def test_a_run_with_another_method_adds_to_what_is_there(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    for name in ("write_sheet_video", "write_scatter"):
        monkeypatch.setattr(benchmark, name, lambda *_: None)
    monkeypatch.setattr("spike4dgs.benchmark.reports.sheet.save_with_pdf", save_figure)
    monkeypatch.setattr(command, "typical_fit_seconds", dict)

    def go(*methods: str, **options: Any) -> str:
        assert run_here((small_scene,), methods=methods, out=out, device="cpu", metrics=("psnr",), **options) == 0
        return capsys.readouterr().out

    def rows() -> list[dict[str, str]]:
        return list(csv.DictReader((out / "results.csv").read_text().splitlines()))

    def height() -> int:
        with Image.open(out / "sheet_pattern-0.png") as image:
            return image.height

    go("counts")
    alone, one = rows(), height()
    assert [r["method"] for r in alone] == ["counts"]
    text = go("quick+counts")
    assert [r["method"] for r in rows()] == ["counts", "quick+counts"] and rows()[0] == alone[0]
    assert height() > 1.2 * one
    table = text.partition("Results")[2].partition("images:")[0]
    assert {"counts", "quick+counts"} <= set(table.split())
    for row in rows():
        record = json.loads((out / f"results/{row['method']}.json").read_text())
        cell = record["scenes"]["pattern-0"]
        assert (row["scene"], row["split"], row["status"]) == ("pattern-0", record["dataset"]["split"], "ok")
        assert float(row["psnr"]) == cell["metrics"]["psnr"] and float(row["fit_seconds"]) == cell["fit_seconds"]
        assert cell["metrics"]["niqe"] is None and row["niqe"] == ""
    image = next(out.glob("predictions/counts/*/*/*.exr"))
    for remove in (
        lambda: image.write_bytes(image.read_bytes()[:50]),
        lambda: shutil.rmtree(out / "predictions/counts"),
    ):
        remove()
        go("quick+counts")
        assert height() == one and len(rows()) == 2, "a method without its predictions is in the table alone"
    go("counts", seed=1)
    assert [(r["method"], r["seed"]) for r in rows()] == [("quick+counts", "0"), ("counts", "1")], "replaced, not twice"


@pytest.mark.usefixtures("installed", "brief")
def test_several_seeds_have_folders_of_their_own_and_one_row_of_the_table(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    for methods in (("counts",), ("quick+counts",)):
        options: dict[str, Any] = {"seed": 2, "seeds": 3, "device": "cpu", "metrics": ("psnr",)}
        assert run_here((small_scene,), methods=methods, out=out, **options) == 0
    table = capsys.readouterr().out.rpartition("Results")[2].partition("images:")[0]
    rows = list(csv.DictReader((out / "results.csv").read_text().splitlines()))
    assert [(r["method"], r["seed"]) for r in rows] == [(m, k) for m in ("counts", "quick+counts") for k in "234"]
    for method in ("counts", "quick+counts"):
        folders = (out, out / "seed-3", out / "seed-4")
        records = [json.loads((f / f"results/{method}.json").read_text()) for f in folders]
        assert [r["method"]["seed"] for r in records] == [2, 3, 4]
        values = [r["mean"]["psnr"] for r in records]
        assert values == [float(r["psnr"]) for r in rows if r["method"] == method]
        assert re.search(rf" {re.escape(method)} +{np.mean(values):.2f} ± {np.std(values, ddof=1):.2f} ", table)
    assert not (out / "seed-2").exists()


@pytest.mark.usefixtures("installed", "brief")
def test_records_that_do_not_belong_there_are_left_out_and_named(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, other = tmp_path / "out", write_small_scene(tmp_path / "other", seed=5)
    for scene, method in ((other, "counts"), (small_scene, "quick+counts")):
        (out / "results").mkdir(parents=True, exist_ok=True)
        (out / "results/damaged.json").write_text("{")
        run_here((scene,), methods=(method,), out=out, device="cpu", metrics=("psnr",))
    text = " ".join(capsys.readouterr().out.split())
    assert "results/counts.json: other scenes, revisions or split" in text
    assert "results/damaged.json: expected a spike4dgs-result/1 record (JSON)" in text
    assert [r["method"] for r in csv.DictReader((out / "results.csv").read_text().splitlines())] == ["quick+counts"]


@pytest.mark.parametrize(
    ("cell", "kept"),
    [({}, True), ({"budget": 8.0}, False), ({"device": "cuda:0"}, False), ({"budget": None, "device": None}, True)],
)
@pytest.mark.usefixtures("installed", "brief")
def test_records_of_another_budget_or_device_are_in_no_table(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], cell: dict[str, Any], kept: bool
) -> None:
    out = tmp_path / "out"
    go = partial(run_here, (small_scene,), out=out, device="cpu", metrics=("psnr",))
    go(methods=("counts",))
    edit_json(out / "results/counts.json", lambda record: record["scenes"]["pattern-0"].update(cell))
    go(methods=("quick+counts",))
    rows = [r["method"] for r in csv.DictReader((out / "results.csv").read_text().splitlines())]
    assert rows == [*(["counts"] if kept else []), "quick+counts"]
    assert ("results/counts.json: another budget or device" not in " ".join(capsys.readouterr().out.split())) == kept


@pytest.mark.usefixtures("installed", "brief")
def test_a_neighbour_that_no_longer_opens_refuses_no_record(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It was fitted with --allow-gaps, and the record keeps it."""
    with_gaps, other = (write_small_scene(tmp_path / f"data/pattern-{k}", seed=k) for k in range(2))
    lost = [{"camera": "cam_01", "first_tick": 30, "ticks": 2, "reason": "lost"}]
    edit_json(with_gaps / "scene.json", lambda meta: meta.update(gaps=lost))
    write_manifest(with_gaps)
    go = partial(run_here, methods=("counts",), out=tmp_path / "out", device="cpu", metrics=("psnr",))
    assert go((with_gaps,), allow_gaps=True) == 0 and go((other,)) == 0
    assert "counts: claimed" in capsys.readouterr().out
    assert go((other,), allow_gaps=True) == 0
    assert "counts: re-scored" in capsys.readouterr().out


@pytest.mark.usefixtures("installed", "brief")
def test_scenes_that_a_record_keeps_of_earlier_runs_change_neither_the_table_nor_the_exit_code(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, other = tmp_path / "out", write_small_scene(tmp_path / "other", seed=5)

    def go(scenes: Sequence[Path], *methods: str) -> int:
        return run_here(scenes, methods=methods, out=out, device="cpu", metrics=("psnr",))

    def rows() -> list[tuple[str, str]]:
        return [(r["method"], r["scene"]) for r in csv.DictReader((out / "results.csv").read_text().splitlines())]

    assert go((small_scene,), "quick+counts") == 0
    assert go((small_scene, other), "counts") == 0
    for methods in (("counts",), ("counts", "plays-back"), ("plays-back", "counts")):
        assert go((small_scene,), *methods) == 0
        of_counts = [("counts", "pattern-5"), ("counts", "pattern-0")]
        assert rows()[0] == ("quick+counts", "pattern-0") and set(of_counts) <= set(rows())
    assert "not in the table" not in capsys.readouterr().out.rpartition("plays-back on pattern-0")[2]
    with monkeypatch.context() as patch:
        patch.setattr(CountMethod, "fit", FailingMethod.fit)
        patch.setattr(CountMethod, "_result", ValueError("no luck"), raising=False)
        assert go((other,), "quick+counts") == 1
    capsys.readouterr()
    assert go((small_scene,), "quick+counts") == 0
    assert "failed" not in capsys.readouterr().err and ("quick+counts", "pattern-5") in rows(), "the record has it"


@pytest.mark.usefixtures("installed", "brief")
def test_a_seed_that_ran_again_as_the_first_is_counted_once(small_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for method, options in (("counts", {"seeds": 3}), ("counts", {"seed": 1}), ("quick+counts", {})):
        run_here((small_scene,), methods=(method,), out=out, device="cpu", metrics=("psnr",), **options)
    rows = [(r["method"], r["seed"]) for r in csv.DictReader((out / "results.csv").read_text().splitlines())]
    assert rows == [("counts", "1"), ("counts", "2"), ("quick+counts", "0")]
    seeds = [(r["method"]["name"], r["method"]["seed"]) for r in run_records(out)]
    assert sorted(seeds) == sorted((name, int(seed)) for name, seed in rows)


@pytest.mark.usefixtures("installed", "brief")
def test_a_method_that_opens_the_held_out_stream_fails_unless_fits_are_in_process(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["run-benchmark", str(small_scene), "--metrics", "psnr", "--device", "cpu", "--methods", "plays-back"]
    assert main([*arguments, "counts", "--out", str(tmp_path / "apart")]) == 1
    assert capsys.readouterr().err.count("failed: ") == 1
    means = [json.loads((tmp_path / f"apart/results/{m}.json").read_text())["mean"] for m in ("plays-back", "counts")]
    assert means[0]["psnr"] is None and means[1]["psnr"] > 10
    assert main([*arguments, "--out", str(tmp_path / "here"), "--in-process"]) == 0
    assert json.loads((tmp_path / "here/results/plays-back.json").read_text())["mean"]["psnr"] > 25


@pytest.mark.usefixtures("installed", "brief")
def test_another_record_in_a_shared_leaderboard_needs_replace(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = {"methods": ("quick+counts",), "device": "cpu", "metrics": ("psnr",), "leaderboard": tmp_path / "board"}

    def go(seed: int, budget: str = "quick", replace: bool = False) -> int:
        return run_here((small_scene,), out=tmp_path / "out", seed=seed, budget=budget, replace=replace, **options)

    assert go(0) == 0 and go(0) == 0
    assert go(1) == 0, "another seed has an entry of its own"
    assert go(1, "0.5") == 1
    assert "pass --replace" in capsys.readouterr().err
    assert go(1, "0.5", replace=True) == 0
    (path,) = (tmp_path / "board/local").glob("pattern-0@*/quick+counts@seed-1.json")
    assert json.loads(path.read_text())["record"]["scenes"]["pattern-0"]["budget"] == 0.5


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"methods": ("nonsense",)},
            "--methods: expected one of bad, counts, plays-back, quick+counts, found 'nonsense'",
        ),
        ({"budget": "0"}, "--budget: expected quick, standard, paper, or a positive number, 1e+06 at most, found '0'"),
        ({"budget": "nan"}, "or a positive number, 1e+06 at most, found 'nan'"),
        ({"budget": "fast"}, "or a positive number, 1e+06 at most, found 'fast'"),
        ({"device": "tpu"}, "--device: expected auto, cpu or cuda, found 'tpu'"),
        ({"device": "cuda:99"}, "--device: expected a CUDA device of this machine, found 'cuda:99'"),
        ({"scenes": ()}, "scenes: expected at least one scene folder"),
        ({"scenes": (Path("nowhere"),)}, "nowhere: expected a scene folder, found no such folder"),
        ({"leaderboard": Path("tests")}, "--leaderboard: expected a leaderboard or a new folder at tests"),
    ],
)
def test_bad_arguments_are_refused(small_scene: Path, tmp_path: Path, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError) as e:
        run_benchmark(**{"scenes": (small_scene,), "out": tmp_path / "out", **arguments})
    assert message in str(e.value)
    assert not (tmp_path / "out").exists()


def test_a_split_that_a_scene_lacks_is_said_before_the_first_fit(small_scene: Path, tmp_path: Path) -> None:
    """Table 5 compares views-3, views-4 and so on; this scene has but the first."""
    data = tmp_path / "data"
    for world in published(5).worlds:
        folder = shutil.copytree(small_scene, data / f"{world}-0-tiny")
        edit_json(folder / "scene.json", lambda meta: meta["splits"].update({"views-3": meta["splits"]["center"]}))
        write_manifest(folder)
    with pytest.raises(UserError, match="expected a split among center, views-3, found 'views-4'"):
        run_benchmark(table=5, data=data, profile="tiny", methods=("nearest-view",), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("installed", "brief")
def test_a_track_is_a_mode_of_its_own(small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    monkeypatch.setattr(command, "track_scenes", lambda name: {small_scene.name: open_scene(small_scene).revision})
    options = {"data": small_scene.parent, "methods": ("counts",), "device": "cpu", "metrics": ("psnr",)}
    assert run_here(track="moon", out=out, **options) == 0
    assert (out / "leaderboard/local").is_dir(), "the scenes of the track are those in the folder"
    with pytest.raises(UserError, match="--track: expected neither scenes nor a table .*, found --table 1"):
        run_benchmark(track="moon", table=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--table", "1", "--from", "release"], "--from: expected --track beside it, found none"),
        (["scene", "--from", "release"], "--from: expected --track beside it, found none"),
        (["scene", "--profile", "paper"], "--profile: expected --table beside it, found none"),
        (["--track", "ideal", "--profile", "paper"], "--profile: expected --table beside it, found none"),
        (["scene", "--data", "elsewhere"], "--data: expected --table or --track beside it, found none"),
    ],
)
def test_useless_options_are_refused(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run-benchmark", *arguments]) == 2
    assert message in capsys.readouterr().err
