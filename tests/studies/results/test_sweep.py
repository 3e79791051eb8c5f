"""The sweep: a killed one goes on where it was, failed cells are tried again, times count in quiet passes alone."""

import io
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import dummy_methods
import numpy as np
import pytest
from changes import files_in, flip_bit, leave_part
from dummy_methods import CountMethod, FailingMethod, WaitingMethod, WeightlessMethod, run, wait_for
from nosy_methods import Refines
from rich.console import Console
from skimage.metrics import peak_signal_noise_ratio
from small_scenes import write_small_scene

from spike4dgs import baselines, benchmark, method
from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import locked
from spike4dgs.benchmark.method import Method
from spike4dgs.benchmark.release.fingerprint import compare, read_fingerprint, write_fingerprint
from spike4dgs.benchmark.runs.method_code import sources_sha256
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.leaderboard import tracks
from spike4dgs.method.image_network.weights import WEIGHTS as IMAGE_NETWORK
from spike4dgs.method.models.network_weights import ConfigWeights
from spike4dgs.method.msdi.weights import WEIGHTS as MSDI
from spike4dgs.studies.results import code_state as states
from spike4dgs.studies.results.code_state import CodeState, check_clean, code_digest, code_state
from spike4dgs.studies.results.command import Choice, results
from spike4dgs.studies.results.plan import CEILING, Cell, Group, Row, cells_of
from spike4dgs.studies.results.records import key_of, read_records, write_row
from spike4dgs.studies.results.sweep import Outcome, SweepSettings, sweep

STATE = CodeState("0123456789ab", False)


def cells(*rows: str, scenes: tuple[str, ...] = ("pattern-0",), seeds: int = 1) -> list[Cell]:
    group = Group("made", "Made", scenes, tuple(Row(name, seeds, "not tuned") for name in rows))
    return cells_of([group])


def swept(
    folder: Path, planned: list[Cell], methods: Mapping[str, Method], **settings: Any
) -> tuple[Outcome, dict[Any, Any], str]:
    """Sweep in a folder that holds the scenes; return the outcome, the records and what was said."""
    said = io.StringIO()
    where = SweepSettings(folder, folder / "records", folder / "out", **settings)
    outcome = sweep(planned, methods, STATE, where, Console(file=said, width=200, highlight=False))
    return outcome, read_records(folder / "records"), said.getvalue()


@pytest.fixture
def fits_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fits in this process, one metric, no published times for the display: each takes longer than the fit."""
    monkeypatch.setattr("spike4dgs.studies.results.sweep.Apart", lambda: None)
    monkeypatch.setattr("spike4dgs.studies.results.sweep.METRICS", ("psnr",))
    monkeypatch.setattr("spike4dgs.studies.results.sweep.typical_fit_seconds", dict)


@pytest.fixture
def folder(one_small_scene: Path, tmp_path: Path) -> Path:
    shutil.copytree(one_small_scene, tmp_path / "pattern-0")
    return tmp_path


@pytest.mark.usefixtures("fits_here")
def test_one_scene_in_two_splits_has_the_scores_of_each_alone(tmp_path: Path) -> None:
    splits, psnr = ("corner", "center"), {}
    for name, chosen in {"both": splits, **{split: (split,) for split in splits}}.items():
        write_small_scene(tmp_path / name / "pattern-0", splits=True)
        planned = [replace(cell, split=split) for split in chosen for cell in cells("quick")]
        outcome, records, _ = swept(tmp_path / name, planned, {"quick": CountMethod("quick")})
        assert not outcome.left and not outcome.failed
        psnr[name] = {record["split"]: record["metrics"]["psnr"] for record in records.values()}
    assert psnr["both"] == psnr["corner"] | psnr["center"]
    assert psnr["both"]["corner"] != psnr["both"]["center"]


KILLED = """
import sys; sys.path[:0] = sys.argv[1:3]
from pathlib import Path
from dummy_methods import CountMethod, WaitingMethod
from test_sweep import cells, swept
folder = Path(sys.argv[3])
swept(folder, cells("quick", "waits"), {"quick": CountMethod("quick"), "waits": WaitingMethod("waits", folder)})
"""


@pytest.mark.slow  # the run that is killed has processes that fit
@pytest.mark.usefixtures("fits_here")
def test_a_killed_sweep_goes_on_where_it_was_and_repeats_nothing(folder: Path) -> None:
    here, support = Path(__file__).parent, Path(dummy_methods.__file__).parent
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(support), str(here), str(folder)])
    wait_for(lambda: (folder / "begun").exists() or process.poll() is not None)
    process.kill()
    assert process.wait(60) == -signal.SIGKILL
    wait_for(lambda: not list(folder.glob("out/*/*/*/work/*/part-*")))  # what fits ends after its caller
    kept = read_records(folder / "records")
    assert [key[0] for key in kept] == ["quick"]
    assert not list((folder / "records").glob("*.part*"))
    (folder / "go").touch()
    planned, waits = cells("quick", "waits"), WaitingMethod("waits", folder)
    outcome, records, said = swept(folder, planned, {"quick": CountMethod("quick"), "waits": waits})
    assert "2 cells planned, 1 measured, 1 to measure" in said
    assert outcome == Outcome(0, ())
    assert records.items() >= kept.items() and [key[0] for key in records] == ["quick", "waits"]
    assert not (folder / "records" / ".lock").exists()
    before = (folder / "records/quick.json").stat().st_mtime_ns
    assert "0 to measure" in swept(folder, planned, {"quick": CountMethod("quick"), "waits": waits})[2]
    assert (folder / "records/quick.json").stat().st_mtime_ns == before


def test_a_record_says_what_was_measured_of_what(folder: Path) -> None:
    where = SweepSettings(folder, folder / "records", folder / "out")
    changed = CodeState(STATE.commit, True)
    sweep(cells("counts"), {"counts": CountMethod("counts")}, changed, where, Console(file=io.StringIO()))
    (record,) = read_records(folder / "records").values()
    assert record["dirty"] is True
    scene = open_scene(folder / "pattern-0")
    assert key_of(record) == ("counts", "pattern-0", 0, 1.0, "center")
    assert scene.revision.startswith(record["revision"]) and record["commit"] == STATE.commit
    assert (record["tuned_on"], record["knowledge"], record["quiet"]) == ("not tuned", "calibrated", False)
    assert {"psnr", "ssim", "psnr_dynamic", "ssim_dynamic", "flip", "temporal_error"} <= set(record["metrics"])
    assert record["bits_per_second"] == scene.meta["width"] * scene.meta["height"] * scene.rate_hz
    predictions = list((folder / "out").rglob("*.exr"))
    assert len(predictions) == 3 and predictions[0].is_relative_to(folder / "out" / record["code"])


@pytest.mark.usefixtures("fits_here")
def test_a_refined_row_is_its_method_scored_at_the_refined_held_out_poses(folder: Path) -> None:
    """The method renders brighter images at refined poses."""
    methods = {"refines": Refines(folder / "seen.json")}
    _, records, _ = swept(folder, cells("refines", "refines.refined"), methods)
    plain, refined = (next(r for r in records.values() if r["row"] == row) for row in ("refines", "refines.refined"))
    assert plain["error"] is None and plain["metrics"] != refined["metrics"]
    assert plain["code"] == refined["code"]
    (brighter,) = run(folder / "here", [folder / "pattern-0"], Refines(folder / "seen.json"))[1:]
    assert refined["metrics"]["psnr"] == pytest.approx(brighter["mean"]["psnr"], rel=1e-5)


@pytest.mark.usefixtures("fits_here")
def test_a_failed_cell_says_why_and_is_tried_again(folder: Path) -> None:
    planned = cells("bad", "weightless")
    methods = {"bad": FailingMethod("bad", ValueError("no luck")), "weightless": WeightlessMethod("weightless")}
    outcome, records, _ = swept(folder, planned, methods)
    assert len(outcome.failed) == 1, "a cell that lacks weights is skipped"
    assert outcome.left == 0 and "bad on pattern-0, seed 0: failed: ValueError: no luck" in outcome.failed[0]
    failed = next(r for r in records.values() if r["row"] == "bad")
    assert failed["metrics"] == {} and "no luck" in failed["error"]
    halves = [leave_part(folder / name) for name in ("records", "out")]
    outcome, records, said = swept(folder, planned, {**methods, "bad": CountMethod("bad")})
    assert not any(half.exists() for half in halves)
    assert "2 to measure" in said and not outcome.failed
    assert {r["row"]: (r["error"] or "ok")[:7] for r in records.values()} == {"bad": "ok", "weightless": "skipped"}


@pytest.mark.parametrize("name", ["records", "out"])
def test_two_sweeps_do_not_use_one_folder(name: str, folder: Path) -> None:
    message = f"{name}: expected a folder that no other sweep uses, found a run in progress"
    with locked(folder / name / ".lock", "x", "free"), pytest.raises(UserError, match=message):
        swept(folder, cells("a"), {"a": CountMethod("a")})


@pytest.mark.usefixtures("fits_here")
def test_a_quiet_pass_fits_again_what_was_measured_beside_others(folder: Path) -> None:
    (planned,), methods = cells("counts"), {"counts": CountMethod("counts")}
    _, busy, _ = swept(folder, [planned], methods)
    _, quiet, said = swept(folder, [planned], methods, quiet=True)
    (before,), (after,) = busy.values(), quiet.values()
    assert "1 to measure" in said and "fitted anew" in said and after["quiet"] and not before["quiet"]
    assert after["metrics"] == before["metrics"]
    assert "0 to measure" in swept(folder, [planned], methods, quiet=True)[2]
    with pytest.raises(UserError, match="--quiet: expected one worker"):
        swept(folder, [planned], methods, quiet=True, workers=2)


@pytest.mark.usefixtures("fits_here")
@pytest.mark.parametrize(
    "fails", [WeightlessMethod("counts"), FailingMethod("counts", ValueError("no luck"))], ids=["skipped", "failed"]
)
def test_a_quiet_pass_that_fails_keeps_what_was_measured_beside_others(fails: Method, folder: Path) -> None:
    planned = cells("counts", CEILING)
    _, busy, _ = swept(folder, planned, {"counts": CountMethod("counts")})
    ceiling = next(r for r in busy.values() if r["row"] == CEILING)
    write_row(folder / "records", CEILING, [ceiling | {"error": None, "metrics": {"psnr": 50.0}}])
    before = files_in(folder / "records")
    outcome, records, said = swept(folder, planned, {"counts": fails}, quiet=True)
    assert files_in(folder / "records") == before and "1 to measure" in said, "a ceiling has no times"
    (line,) = outcome.failed
    assert line.startswith("counts on pattern-0, seed 0: ") and line.endswith("; its earlier record stays")
    outcome, records, _ = swept(folder, planned, {"counts": CountMethod("counts")}, quiet=True)
    assert not outcome.failed and next(r for r in records.values() if r["row"] == "counts")["quiet"]


@pytest.mark.usefixtures("fits_here")
def test_a_limit_of_time_begins_no_further_cell_and_scenes_may_be_missing(folder: Path) -> None:
    planned = cells("a", "b", scenes=("pattern-0", "pattern-1"))
    methods = {"a": CountMethod("a"), "b": CountMethod("b")}
    outcome, records, said = swept(folder, planned, methods, limit_hours=0.0)
    assert [key[0] for key in records] == ["a"] and outcome.left == 3
    assert "left out: pattern-1" in said and "no further cell" in said
    outcome, records, said = swept(folder, cells("tfp.images", "tfi.images", "a"), methods, limit_hours=0.0)
    assert [key[0] for key in records if key[0].endswith(".images")] == ["tfp.images"] and "no further cell" in said
    with pytest.raises(UserError, match="expected scenes of the plan, such as pattern-7, found none"):
        swept(folder, cells("a", scenes=("pattern-7",)), methods)


@pytest.mark.usefixtures("fits_here")
def test_records_of_other_code_are_kept_and_named_and_those_of_another_scene_refused(folder: Path) -> None:
    (planned,), methods = cells("a"), {"a": CountMethod("a"), "b": CountMethod("b")}
    _, records, _ = swept(folder, [planned], methods)
    write_row(folder / "records", "a", [{**r, "code": "ffffffffffff"} for r in records.values()])
    assert "kept, measured by other code: a;" in swept(folder, [planned], methods)[2]
    write_row(folder / "records", "a", [{**r, "revision": "ffffffffffff"} for r in records.values()])
    with pytest.raises(UserError, match="expected revision ffffffffffff, as in the records"):
        swept(folder, cells("b"), methods)


@pytest.mark.usefixtures("fits_here")
def test_a_scene_of_another_processor_joins_the_records_where_it_differs_by_rounding(folder: Path) -> None:
    methods = {"a": CountMethod("a"), "b": CountMethod("b")}
    _, records, _ = swept(folder, cells("a"), methods)
    path, own = folder / "records/scenes/pattern-0.npz", open_scene(folder / "pattern-0").revision
    made = read_fingerprint(path)
    assert made.revision == own and compare(open_scene(folder / "pattern-0"), made).is_equivalent
    write_row(folder / "records", "a", [{**r, "revision": "f" * 12} for r in records.values()])
    write_fingerprint(path, replace(made, revision="f" * 64))
    _, records, said = swept(folder, cells("b"), methods)
    of_b = next(r for r in records.values() if r["row"] == "b")
    assert (of_b["revision"], of_b["equivalent"]) == ("f" * 12, own[:12]) and "0.0000% of its spike bits" in said
    spikes = {k: v + (k.startswith("spikes/") and np.uint8(40)) for k, v in made.arrays.items()}
    write_fingerprint(path, replace(made, revision="f" * 64, arrays=spikes))
    with pytest.raises(UserError, match="expected revision ffffffffffff.*spikes"):
        swept(folder, cells("b"), methods)


@pytest.mark.usefixtures("fits_here")
def test_a_released_scene_is_known_by_the_releases_fingerprint(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    methods = {"a": CountMethod("a")}
    swept(folder, cells("a"), methods)
    own, released = folder / "records/scenes/pattern-0.npz", folder / tracks.RELEASE / f"pattern-0@{'f' * 12}.npz"
    released.parent.mkdir()
    write_fingerprint(released, replace(read_fingerprint(own), revision="f" * 64))
    own.unlink()
    monkeypatch.setattr(tracks, "FOLDER", folder)
    kept = read_records(folder / "records").values()
    write_row(folder / "records", "a", [{**r, "revision": "f" * 12} for r in kept])
    assert "0.0000% of its spike bits" in swept(folder, cells("a"), methods)[2]
    assert not own.exists()
    (folder / "records/a.json").unlink()
    revision = open_scene(folder / "pattern-0").revision
    of_release = released.with_name(f"pattern-0@{revision[:12]}.npz")
    of_release.write_bytes(b"as it was frozen")  # a sweep without records leaves it alone
    swept(folder, cells("a"), methods)
    assert of_release.read_bytes() == b"as it was frozen" and not own.exists()


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        (
            Choice(only=("table9",)),
            "--only: expected groups among table1, table2, .*, modality, .*, steps-quick, .*, trial, found table9",
        ),
        (Choice(only=("trial",), rows=("tfi+stg", "tfp+stg")), "--rows: expected rows among nearest-view, .*tfi.stg;"),
        (Choice(only=("trial",), scenes_of=Path("nowhere")), "nowhere: expected scenes of the plan, such as car-0"),
    ],
)
def test_what_is_not_there_is_named_before_anything_is_fitted(
    choice: Choice, message: str, checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(states, "ROOT", checkout)
    with pytest.raises(UserError, match=message):
        results(choice=choice)
    assert not (checkout / "studies/results/records").exists()


def test_an_installation_without_a_checkout_is_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(states, "ROOT", tmp_path)
    with pytest.raises(UserError, match="expected a checkout with its docs"):
        results()


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A git checkout with a page and a module of a method."""
    for name in ("docs/results/page.md", "method/a.py", "studies/results/plan.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("1\n")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@example.org"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "first"]):
        subprocess.run([*git, *command], check=True)
    return tmp_path


def test_code_that_is_not_committed_is_refused_unless_told(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_clean(code_state(checkout), False)
    (checkout / "docs/results/page.md").write_text("2\n")
    (checkout / "studies/results/records").mkdir()
    (checkout / "studies/results/records/a.json").write_text("{}")
    assert not code_state(checkout).dirty, "records and pages are no code"
    for name in ("method/a.py", "method/new.py", "studies/results/plan.py"):
        before = (checkout / name).read_text() if (checkout / name).exists() else None
        (checkout / name).write_text("3\n")
        assert code_state(checkout).dirty, name
        (checkout / name).unlink() if before is None else (checkout / name).write_text(before)
    (checkout / "method/a.py").write_text("3\n")
    monkeypatch.setattr(states, "ROOT", checkout)
    with pytest.raises(UserError, match="found changes that are not committed; commit it, or pass --allow-dirty"):
        results()
    check_clean(code_state(checkout), True)


def test_a_method_of_ours_does_not_change_with_the_baselines() -> None:
    ours, rooms = code_digest("spike4dgs-x"), [benchmark, method, baselines]
    assert sources_sha256(rooms[:2]).startswith(ours) and ours != code_digest("tfp+stg")
    assert sources_sha256(rooms).startswith(code_digest("tfp+stg")) and len(ours) == 12


@pytest.mark.parametrize(
    ("kind", "rows", "others"),
    [
        (IMAGE_NETWORK, ("spike4dgs", "msdi+colmap+4dgs", "msdi.images", "msdi+shading.images"), ("spk2img+stg",)),
        (MSDI, ("spike4dgs", "spike4dgs-uncalibrated"), ("msdi+colmap+4dgs", "msdi.images", "spike4dgs-x")),
    ],
)
def test_a_network_with_other_weights_is_other_code_of_its_rows(
    kind: ConfigWeights[Any], rows: tuple[str, ...], others: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / "network.safetensors").write_bytes(kind.shipped.read_bytes())
    flip_bit(tmp_path / "network.safetensors", -1)
    before = {row: code_digest(row) for row in (*rows, *others)}
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(kind.variable, str(tmp_path / "network.safetensors"))
        changed = {row for row, digest in before.items() if code_digest(row) != digest}
    assert changed == set(rows)


def test_images_are_measured_without_a_fit_and_corrected_where_the_camera_is_known(folder: Path) -> None:
    rows = ("tfp.images", "tfp+rig-flat.images", "tfp+shading.images")
    outcome, records, _ = swept(folder, cells(*rows), {})
    assert (outcome.left, outcome.failed) == (0, ())
    plain, corrected, shaded = (next(r for r in records.values() if r["row"] == row) for row in rows)
    scene = open_scene(folder / "pattern-0")
    pairs = [
        (scene.ground_truth(t), IMAGES["tfp"](scene.stream(t.camera), [t.tick], scene.radiance_gain)[0])
        for t in scene.targets
    ]
    expected = [peak_signal_noise_ratio(*np.clip(pair, 0, 1).astype(float), data_range=1) for pair in pairs]
    assert plain["metrics"]["psnr"] == pytest.approx(np.mean(expected), abs=1e-3) and plain["error"] is None
    assert plain["render_fps"] > 0 and plain["fit_seconds"] is None
    assert corrected["error"] == "skipped: no calibration recordings of a held-out camera" and not corrected["metrics"]
    assert shaded["error"] == "skipped: the clips tell no shading of a held-out camera"
    assert [r["knowledge"] for r in (plain, shaded, corrected)] == ["uncalibrated", "uncalibrated", "calibrated"]
