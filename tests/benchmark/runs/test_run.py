import importlib
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import dummy_methods
import numpy as np
import pytest
from changes import exchange, flip_bit, leave_part
from dummy_methods import CountMethod, FailingMethod, prediction_bytes, without_timings
from nosy_methods import Refines
from rich.console import Console
from small_scenes import write_small_scene

from spike4dgs.benchmark import Budget, FitRequest, TrainingScene, UserError, get_method, open_scene
from spike4dgs.benchmark import method as recipes
from spike4dgs.benchmark.runs import cell
from spike4dgs.benchmark.runs.cell import FitClock, Job, render_targets
from spike4dgs.benchmark.runs.method_code import code_of
from spike4dgs.benchmark.runs.record import check_record, of_scenes
from spike4dgs.benchmark.runs.run import Settings, run_matrix
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import read_exr, write_exr, write_mask
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.weights import WeightsError

run = partial(dummy_methods.run, metrics=("psnr",))


def test_a_second_run_scores_the_files_and_fits_nothing(small_scene: Path, tmp_path: Path) -> None:
    first, again = CountMethod(), CountMethod()
    records = dummy_methods.run(tmp_path / "out", [small_scene], first)
    assert first.fits == 1 and records == [json.loads((tmp_path / "out/results/counts.json").read_text())]
    half = leave_part(tmp_path / "out/results")
    assert dummy_methods.run(tmp_path / "out", [small_scene], again)[0]["scenes"] == records[0]["scenes"]
    assert again.fits == 0 and not half.exists()
    assert not list((tmp_path / "out/work").iterdir()), "checkpoints of finished fits go"


@pytest.fixture
def notes(small_scene: Path, tmp_path: Path) -> Callable[..., str]:
    """Return a function that runs methods on a scene, and returns what is printed."""

    def run_noted(*methods: Any, **settings: Any) -> str:
        console = Console(file=(text := io.StringIO()), width=200)
        out = Settings(tmp_path / "out", metrics=("psnr",), **settings)
        run_matrix([open_scene(small_scene)], methods, out, console)
        return text.getvalue()

    return run_noted


def test_what_is_kept_and_what_is_replaced_says_why_and_refit_fits_anew(notes: Callable[..., str]) -> None:
    assert "kept" not in notes(CountMethod()) and "kept: predictions of 2" in notes(CountMethod())
    assert "replaces predictions with another settings" in notes(CountMethod(extra=1))
    assert "replaces predictions with another seed, settings" in notes(CountMethod(), seed=2)
    again = CountMethod()
    assert "fitted anew (--refit)" in notes(again, seed=2, refit=True) and again.fits == 1


def test_predictions_of_a_method_that_was_given_more_are_replaced(notes: Callable[..., str]) -> None:
    more, less, again = CountMethod(), CountMethod(), CountMethod()
    more.given = ("poses", "flat-field", "frames")  # type: ignore[attr-defined]
    less.given = again.given = ("poses",)  # type: ignore[attr-defined]
    assert notes(CountMethod()) and "kept" in notes(more), "predictions that do not say what was given stay valid"
    assert "kept" not in notes(more, refit=True)
    assert "replaces predictions with another given" in notes(less) and less.fits == 1
    assert "kept" in notes(again) and again.fits == 0


def test_the_time_left_of_cells_that_workers_fit_follows_the_elapsed_time(notes: Callable[..., str]) -> None:
    notes(CountMethod(), seeds=3)
    typical_s = {"counts": 1e6}
    assert " h " in notes(CountMethod(), seeds=3, typical_s=typical_s), "one after another, as long as is typical"
    spread = notes(CountMethod(), seeds=3, typical_s=typical_s, workers=2)
    assert spread.count(" left") == 2 and " h " not in spread


@pytest.fixture
def plug_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[float], CountMethod]:
    """Return the method of a package whose helper module changes, installed again in the same version."""
    package = tmp_path / "edited_plug_in"
    package.mkdir()
    (package / "__init__.py").write_text(
        "from dummy_methods import CountMethod\nfrom .model import LEVEL\n"
        "class Method(CountMethod):\n"
        "    def fit(self, scene, request):\n"
        "        model = super().fit(scene, request)\n"
        "        model.image = model.image * LEVEL\n"
        "        return model\n"
    )
    monkeypatch.syspath_prepend(tmp_path)

    def install(level: float) -> CountMethod:
        (package / "model.py").write_text(f"LEVEL = {level}  # of the images\n")
        for name in [m for m in sys.modules if m.startswith("edited_plug_in")]:
            del sys.modules[name]
        importlib.invalidate_caches()
        shutil.rmtree(package / "__pycache__", ignore_errors=True)
        method: CountMethod = importlib.import_module("edited_plug_in").Method()
        return method

    return install


def test_edited_code_of_a_plug_in_is_fitted_and_scored_anew(
    small_scene: Path, tmp_path: Path, plug_in: Callable[[float], CountMethod]
) -> None:
    scores = []
    for level in (1.0, 0.5, 0.5):
        method = plug_in(level)
        scores.append((run(tmp_path / "out", [small_scene], method)[0]["mean"]["psnr"], method.fits))
    assert [fits for _, fits in scores] == [1, 1, 0] and scores[0] != scores[1] and scores[1][0] == scores[2][0]


def test_a_record_has_no_scores_of_other_code_beside_its_own(
    small_scene: Path, tmp_path: Path, plug_in: Callable[[float], CountMethod]
) -> None:
    other = write_small_scene(tmp_path / "other", seed=1)
    run(tmp_path / "out", [small_scene, other], plug_in(1.0))
    (same,) = run(tmp_path / "out", [small_scene], plug_in(1.0))
    assert list(same["scenes"]) == ["pattern-1", "pattern-0"]
    (edited,) = run(tmp_path / "out", [small_scene], plug_in(0.5))
    assert list(edited["scenes"]) == ["pattern-0"]
    assert edited["mean"]["psnr"] == edited["scenes"]["pattern-0"]["metrics"]["psnr"]


def test_a_method_of_this_package_has_no_code_in_its_key() -> None:
    assert code_of(get_method("tfp+4dgs")) == {} and list(code_of(CountMethod())) == ["dummy_methods"]


def test_one_scene_run_again_keeps_the_cells_of_the_others(small_scene: Path, tmp_path: Path) -> None:
    other = write_small_scene(tmp_path / "other", seed=1)
    (both,) = run(tmp_path / "out", [small_scene, other], CountMethod())
    (again,) = run(tmp_path / "out", [other], CountMethod())
    assert again["scenes"] == both["scenes"] and again["dataset"] == both["dataset"] and again["mean"] == both["mean"]
    assert of_scenes(again, ["pattern-1"])["dataset"]["scenes"] == {"pattern-1": both["dataset"]["scenes"]["pattern-1"]}
    (changed,) = run(tmp_path / "out", [other], CountMethod(extra=1))
    assert list(changed["scenes"]) == ["pattern-1"], "cells of other parameters are no part of the record"
    (longer,) = run(tmp_path / "out", [small_scene], CountMethod(extra=1), budget=Budget(2.0))
    assert list(longer["scenes"]) == ["pattern-0"], "nor those of another budget"
    check_record(again, "again")


class WarmingMethod(CountMethod):
    """Notes whether the clock of its fit runs, when it is warmed up and when it fits."""

    def __init__(self, work: Path) -> None:
        super().__init__()
        self.work, self.clocks = work, []  # type: ignore[var-annotated]

    def warm_up(self, request: FitRequest) -> None:
        assert request.seed == 3
        self.clocks.append(len(list(self.work.rglob("fit_clock.json"))))

    def fit(self, scene: TrainingScene, request: FitRequest) -> Any:
        self.clocks.append(len(list(self.work.rglob("fit_clock.json"))))
        return super().fit(scene, request)


def test_a_method_is_warmed_up_before_the_clock_of_its_fit(small_scene: Path, tmp_path: Path) -> None:
    method = WarmingMethod(tmp_path / "out/work")
    (record,) = run(tmp_path / "out", [small_scene], method, seed=3)
    assert record["scenes"]["pattern-0"]["status"] == "ok" and method.clocks == [0, 1]
    (plain,) = run(tmp_path / "plain", [small_scene], CountMethod(), seed=3)
    assert plain["mean"] == record["mean"]


def test_what_the_first_rendering_loads_is_not_in_the_images_a_second(small_scene: Path) -> None:
    loaded: list[float] = []

    class Loading:
        def render(self, camera: Camera, t_us: float) -> Any:
            time.sleep(0 if loaded else 0.5)
            loaded.append(t_us)
            return np.full((camera.height, camera.width), len(loaded), np.float32)

    scene, added = open_scene(small_scene), []
    costs = render_targets(Loading(), scene, scene.cameras, "m", "cpu", lambda *found: added.append(found))
    assert [target for target, _, _ in added] == list(scene.targets) and len(loaded) == len(added) + 1
    assert (costs["render_fps"] or 0) > len(added) / 0.4


def test_whatever_changes_the_result_changes_the_key(tmp_path: Path) -> None:
    def key(method: CountMethod, seed: int = 0, scale: float = 1.0) -> str:
        return Job(method, open_scene(scene), seed, "cpu", recipes.Budget(scale)).key

    scene = write_small_scene(tmp_path / "scene")
    keys = [key(CountMethod()), key(CountMethod(extra=1)), key(CountMethod(), 1), key(CountMethod(), scale=0.5)]
    (np.fromfile(scene / "spikes/cam_00.dat", np.uint8) ^ 1).tofile(scene / "spikes/cam_00.dat")
    write_manifest(scene)
    keys.append(key(CountMethod()))
    assert len(set(keys)) == len(keys)


def test_damaged_predictions_are_made_again(small_scene: Path, tmp_path: Path) -> None:
    run(tmp_path / "out", [small_scene], CountMethod())
    before = prediction_bytes(tmp_path / "out")
    path = tmp_path / "out/predictions/counts/pattern-0/cam_03/000040.exr"
    path.write_bytes(path.read_bytes()[:-1] + b"\0")
    again = CountMethod()
    run(tmp_path / "out", [small_scene], again)
    assert again.fits == 1 and prediction_bytes(tmp_path / "out") == before


def test_predictions_are_what_the_model_rendered(small_scene: Path, tmp_path: Path) -> None:
    method = CountMethod()
    models = []
    fit = method.fit
    method.fit = lambda *a, **k: models.append(fit(*a, **k)) or models[-1]  # type: ignore[method-assign]
    run(tmp_path / "out", [small_scene], method)
    found = read_exr(tmp_path / "out/predictions/counts/pattern-0/cam_03/000060.exr")
    assert np.array_equal(found, (models[0].image + 1e-6 * 3000).astype(np.float32).astype(np.float16))


def test_a_fit_gets_only_the_training_views(small_scene: Path, tmp_path: Path) -> None:
    seen: list[TrainingScene] = []

    class Nosy(CountMethod):
        def fit(self, scene: TrainingScene, *args: Any, **kwargs: Any) -> Any:
            seen.append(scene)
            return super().fit(scene, *args, **kwargs)

    run(tmp_path / "out", [small_scene], Nosy())
    assert type(seen[0]) is TrainingScene
    assert [c.id for c in seen[0].cameras] == ["cam_00", "cam_01", "cam_02"]
    assert not any("cam_03" in s.source for s in seen[0].streams)


@pytest.mark.parametrize(
    ("result", "reason"),
    [
        (ValueError("no luck"), "ValueError: no luck"),
        (MemoryError(), "MemoryError"),
        (ValueError("of \udcff.exr"), r"ValueError: of \udcff.exr"),  # the name of a file that is no UTF-8
        (UserError("scene: expected light, found none; add some"), "scene: expected light, found none; add some"),
        (np.zeros((3, 4), np.float32), "expected a floating-point array of shape (24, 40), found float32 (3, 4)"),
        (np.zeros((24, 40), np.uint8), "found uint8 (24, 40)"),
        (None, "found NoneType"),
        (np.full((24, 40), np.nan), "expected finite radiance, found NaN or infinity"),
        (np.full((24, 40), 1e6), "expected a finite gray image within +-65504"),
    ],
)
def test_one_failure_never_stops_the_rest(small_scene: Path, tmp_path: Path, result: Any, reason: str) -> None:
    bad, good = run(tmp_path, [small_scene], FailingMethod("bad", result), CountMethod("good"))
    assert good["scenes"]["pattern-0"]["status"] == "ok" and good["mean"]["psnr"] > 5
    cell = bad["scenes"]["pattern-0"]
    assert cell["status"] == "failed" and reason in cell["error"] and bad["mean"]["psnr"] is None
    log = (tmp_path / "logs/bad__pattern-0.log").read_text()
    assert "Traceback" in log and type(result).__name__ in log or "UserError" in log
    assert not (tmp_path / "predictions/bad/pattern-0").exists()


def test_a_failed_cell_is_tried_again(small_scene: Path, tmp_path: Path) -> None:
    run(tmp_path, [small_scene], FailingMethod("counts", ValueError("no luck")))
    record = run(tmp_path, [small_scene], CountMethod("counts"))[0]
    assert record["scenes"]["pattern-0"]["status"] == "ok"
    assert not list((tmp_path / "logs").iterdir())


def test_a_killed_run_resumes_and_equals_an_uninterrupted_one(small_scene: Path, tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    expected = run(whole, [small_scene], CountMethod("first"), CountMethod("second"), seed=3)
    script = Path(dummy_methods.__file__)
    done = subprocess.run([sys.executable, str(script), str(killed), str(small_scene), "second", "2"])
    assert done.returncode == -signal.SIGKILL
    assert not (killed / "predictions/second").exists()
    first, second = CountMethod("first"), CountMethod("second")
    steps: list[str] = []
    for method in (first, second):
        fit = method.fit

        def watched(scene: Any, request: FitRequest, fit=fit):
            def both(done: int, total: int, note: str = "") -> None:
                steps.append(note)
                request.progress(done, total, note)

            return fit(scene, replace(request, progress=both))

        method.fit = watched  # type: ignore[method-assign]
    found = run(killed, [small_scene], first, second, seed=3)
    assert steps[:2] == ["step 2", "step 3"], "the fit goes on where its checkpoint was"
    assert first.fits == 0, "the first one was whole"
    assert prediction_bytes(killed) == prediction_bytes(whole)
    assert [without_timings(r) for r in found] == [without_timings(r) for r in expected]


def test_the_fit_time_of_a_resumed_fit_is_the_sum_of_its_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(cell.time, "perf_counter", lambda: now)
    path, checkpoint, said = tmp_path / "clock.json", tmp_path / "checkpoint", list[int]()

    def progress(done: int, total: int, note: str = "") -> None:
        said.append(done)

    first = FitClock(path, checkpoint)
    now += 40
    report = first.watched(progress)
    report(1, 9)
    assert FitClock(path, checkpoint).before == 0, "without a checkpoint everything is done again"
    checkpoint.write_text("half done")
    os.utime(checkpoint, (1.0, 1.0))  # a wall clock that was moved
    report(2, 9)
    now += 10
    report(3, 9)  # no new checkpoint: what comes after is lost with a kill, and done again
    second = FitClock(path, checkpoint)
    assert second.before == second.seconds() == 40
    now += 30
    checkpoint.write_text("three quarters")
    second.watched(progress)(5, 9)
    assert FitClock(path, checkpoint).before == 70
    assert FitClock(path, checkpoint).before == 70, "killed before it wrote a checkpoint"
    assert said == [1, 2, 3, 5]
    checkpoint.unlink()
    assert FitClock(path, checkpoint).before == 0


def test_two_runs_cannot_share_a_folder(small_scene: Path, tmp_path: Path) -> None:
    class Second(CountMethod):
        def fit(self, *args: Any, **kwargs: Any) -> Any:
            with pytest.raises(UserError, match="a run in progress"):
                run(tmp_path, [small_scene], CountMethod())
            return super().fit(*args, **kwargs)

    assert run(tmp_path, [small_scene], Second())[0]["scenes"]["pattern-0"]["status"] == "ok"


@pytest.mark.parametrize("name", ["spikes/cam_01.dat", "images/cam_03/000040.exr", "masks/cam_03/000020.png"])
def test_a_damaged_scene_is_refused_before_any_work(small_scene: Path, tmp_path: Path, name: str) -> None:
    flip_bit(small_scene / name, (small_scene / name).stat().st_size // 2)
    method = CountMethod()
    with pytest.raises(UserError, match=name):
        run(tmp_path / "out", [small_scene], method)
    assert method.fits == 0


@pytest.mark.parametrize("kind", ["images", "masks"])
def test_exchanged_truth_is_not_scored_under_the_first_revision(small_scene: Path, tmp_path: Path, kind: str) -> None:
    revision = open_scene(small_scene).revision
    if kind == "images":
        name = "images/cam_03/000040.exr"
        exchange(small_scene, name, lambda path: write_exr(path, np.full((24, 40), 0.5, np.float32), 2000.0))
    else:
        name = "masks/cam_03/000040.png"
        exchange(small_scene, name, lambda path: write_mask(path, np.ones((24, 40), bool)))
    assert open_scene(small_scene).revision == revision, "the manifest claims the content of the first one"
    method = CountMethod()
    with pytest.raises(UserError, match=f"{name}: expected content .*; the manifest claims another content"):
        run(tmp_path / "out", [small_scene], method)
    assert method.fits == 0


def test_scenes_methods_and_small_views_are_refused_before_any_fit(small_scene: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="distinct scenes"):
        run(tmp_path / "out", [small_scene, small_scene], CountMethod())
    with pytest.raises(UserError, match="expected a name of letters"):
        run(tmp_path / "out", [small_scene], CountMethod("a/b"))
    small = write_small_scene(tmp_path / "small", width=8, height=8)
    with pytest.raises(UserError, match="expected views of 11 pixels or more each way, found 8"):
        run(tmp_path / "out", [small], CountMethod())
    assert not (tmp_path / "out/predictions").exists()


def test_a_method_without_its_weights_is_skipped_and_the_record_has_no_path(small_scene: Path, tmp_path: Path) -> None:
    error = WeightsError(f"{tmp_path}/net.pth: expected weights, found no such file", "needs net.pth")
    (record,) = run(tmp_path / "out", [small_scene], FailingMethod("learned", error))
    (cell,) = record["scenes"].values()
    assert (cell["status"], cell["error"]) == ("skipped", "needs net.pth")
    assert str(tmp_path) not in json.dumps(record["scenes"])
    assert str(tmp_path) in (tmp_path / "out/logs/learned__pattern-0.log").read_text()


def test_views_to_refine_by_stay_out_of_a_run_that_wants_none(small_scene: Path, tmp_path: Path) -> None:
    records = run(tmp_path / "out", [small_scene], Refines(tmp_path / "seen.json"), metrics=("psnr",), refined=False)
    assert [r["method"]["name"] for r in records] == ["refines"] and not (tmp_path / "seen.json").exists()
