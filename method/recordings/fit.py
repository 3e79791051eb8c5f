"""Fit a model to a recording, with what one wants to see of it.

OUT/model.safetensors   the model, for `view` and `render`
OUT/sheet.png           training views: image from spikes, render, error map
OUT/video.mp4           the clip in slow motion along an orbit
OUT/report.html         cameras, rates, poses, bad pixels, residuals, held-out cameras, times, versions
OUT/predictions/        the held-out cameras, rendered, for `score`
OUT/work/KEY/           the checkpoint of an unfinished fit
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from spike4dgs.benchmark.environment import command_line, device_type, environment, harness, utc_now
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import locked, remove_parts, sha256_json
from spike4dgs.benchmark.method import FitRequest, Method
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.reports.video import video_writer
from spike4dgs.benchmark.runs.cell import timed_fit
from spike4dgs.benchmark.runs.display import RunDisplay
from spike4dgs.benchmark.runs.predictions import MethodInfo, check_place
from spike4dgs.benchmark.runs.provenance import Provenance, Savable
from spike4dgs.benchmark.scene.manifest import check_scene_folder
from spike4dgs.benchmark.spikes.folder import NAME as STREAMS
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.models.saved_model import SavedModel, load_model
from spike4dgs.method.recordings.comparison import compare, mean_residual, write_sheet
from spike4dgs.method.recordings.held_out import SHOWN, HeldOutScores, held_out_views, judge_held_out
from spike4dgs.method.recordings.recording import Recording, open_recording
from spike4dgs.method.recordings.report_page import Report, write_report
from spike4dgs.method.recordings.self_calibrated import Source, self_calibrated
from spike4dgs.method.viewing.camera_paths import orbit, resized
from spike4dgs.method.viewing.render_video import frame_times, render_frames

MODEL, SHEET, VIDEO, REPORT = "model.safetensors", "sheet.png", "video.mp4", "report.html"
PREDICTIONS = "predictions"
VIDEO_S, FPS, SCALE = 10.0, 30.0, 2.0  # of the video: its length, and its size as a multiple of the training views'
SLOW_FRAME_S, SLOW_FPS = 0.5, 3.0  # a model that takes longer for a frame, such as a radiance field, gets fewer


def fit_recording(
    scene: Path,
    method: Method,
    out: Path,
    request: FitRequest,
    maker: ImageMaker,
    *,
    poses: Source = "auto",
    clocks: Source = "auto",
) -> None:
    """Fit a method to a scene folder or a folder of streams, and write all that `OUT` holds; say what is found.

    `maker` gives the sheet its images where the method has none. Poses and clocks: "auto" (estimated anew where the
    clip shows that they are wrong) or "given".
    """
    console, times, seed = make_console(), dict[str, float](), request.seed
    for name in ("scene.json", STREAMS):  # a scene's sheet would be replaced
        if (out / name).is_file():
            raise problem(out, "a folder for the results of a fit", f"a recording ({name})", "choose another --out")
    if not (scene / STREAMS).is_file():
        check_scene_folder(scene)  # before OUT is made
    with locked(out / ".lock", out, "a folder that no other fit uses"):
        check_place(out / PREDICTIONS)  # a benchmark's are of all methods and scenes
        remove_parts(out)
        with _timed(times, "opening"):
            recording = open_recording(scene, seed)
        with _timed(times, "poses and clocks"):
            own_poses = isinstance(method, RecipeMethod) and method.initialization.estimates_poses
            checked = self_calibrated(recording, "given" if own_poses else poses, clocks, seed)
            recording = checked.recording
        origin = _poses(recording, method, "poses" in checked.changed)
        for text in (f"poses: {origin}", *recording.notes):
            _say(console, text)
        saved = _fitted(method, recording, request, out, console, checked.changed)
        times["fit"] = saved.provenance.fit_seconds
        cameras = saved.provenance.cameras
        with _timed(times, "sheet"):
            found = compare(method, saved.model, recording.training, cameras, request.device, maker)
            write_sheet(out / SHEET, found, f"{saved.title}: training views, residual {mean_residual(found):.2f} dB")
        with _timed(times, "video"):
            slow_motion = _write_video(out / VIDEO, saved)
        judged = None
        if recording.scene and recording.held_out:
            with _timed(times, "held-out cameras"):
                views = held_out_views(recording.scene, recording.training, checked.changed, seed)
                judged = judge_held_out(saved, recording.scene, views, out / PREDICTIONS)
        report = Report(
            about=saved.provenance,
            source=scene,
            poses=origin,
            checked=checked,
            found=found,
            judged=judged,
            slow_motion=slow_motion,
            seconds=times,
            model_mb=(out / MODEL).stat().st_size / 1e6 if (out / MODEL).is_file() else None,
            environment=environment(request.device),
            command=command_line(),
            video=VIDEO,
        )
        write_report(out / REPORT, report, out / SHEET)
    residual = f"{mean_residual(found):.2f} dB (not a score)"
    _say(console, f"fit: {times['fit']:.1f} s; residual of the training views {residual}")
    if judged:
        _say(console, f"held-out {', '.join(recording.held_out)} by their own spikes: {_scores(judged)}")
    written = [name for name in (MODEL, SHEET, VIDEO, REPORT) if (out / name).is_file()]
    _say(console, f"results: {out}/{{{','.join(written)}}}")


def _scores(judged: HeldOutScores) -> str:
    """Return the scores of the held-out cameras in a line, or why there are none."""
    known = [m for m in SHOWN if judged.mean[m] is not None]
    values = ", ".join(f"{m} {METRICS[m].format(judged.mean[m])}" for m in known)
    return values or f"no score ({judged.notes[SHOWN[0]]})"


def _poses(recording: Recording, method: Method, adjusted: bool) -> str:
    """Return in words where the poses of a fit come from."""
    if isinstance(method, RecipeMethod) and method.initialization.estimates_poses:
        start = method.recipe.initialization
        return f"estimated by the method ({start}), then moved to those {recording.poses}"
    return f"{recording.poses}, then adjusted" if adjusted else recording.poses


def _fitted(
    method: Method, recording: Recording, request: FitRequest, out: Path, console: Console, changed: tuple[str, ...]
) -> SavedModel:
    """Return the fitted model, which OUT then holds: that of an earlier run, or a new one.

    Raises UserError where OUT holds a model of another fit. A method's models that cannot be saved are of one run.
    """
    path, about = out / MODEL, _provenance(method, recording, request, changed)
    if path.exists():
        saved = load_model(path, request.device)
        if _key(saved.provenance) != _key(about):
            found = f"{saved.title}, budget {saved.provenance.budget}, seed {saved.provenance.method['seed']}"
            fix = "choose another --out, or remove it"
            raise problem(path, "no model, or one of this recording, method, budget and seed", found, fix)
        _say(console, "the model is there: only sheet, video and report are made again")
        return saved
    for name in (SHEET, VIDEO, REPORT):  # of a model that was removed
        (out / name).unlink(missing_ok=True)
    shutil.rmtree(out / PREDICTIONS, ignore_errors=True)
    work = out / "work" / _key(about)[:16]
    with RunDisplay(console, 1) as display, display.cell(f"{about.name} on {about.scene}") as shown:
        watched = replace(request, progress=shown.progress)
        model, fit_seconds = timed_fit(method, recording.training, watched, work, shown.note)
    cameras = getattr(model, "cameras", ()) or about.cameras  # as the fit left them, where the model knows
    about = replace(about, cameras=cameras, fit_seconds=fit_seconds, created=utc_now())
    if isinstance(model, Savable):
        model.save(path, about)
    else:
        _say(console, f"models of {method.name} cannot be saved: there is no {MODEL}, and each run fits anew")
    shutil.rmtree(work, ignore_errors=True)
    with suppress(OSError):  # it holds others' checkpoints
        work.parent.rmdir()
    return SavedModel(model, about)


def _provenance(method: Method, recording: Recording, request: FitRequest, changed: tuple[str, ...]) -> Provenance:
    """Return what is known of a fit before it; `changed` is what of the recording was estimated anew."""
    version = getattr(method, "version", None) or harness()["version"]
    trained_on = tuple(getattr(method, "trained_on", ()))
    scene = recording.training
    params = {**method.params, **({"estimated": list(changed)} if changed else {})}
    return Provenance(
        method=MethodInfo(method.name, version, params, request.seed, trained_on).as_dict(),
        scene=scene.id,
        scene_revision=scene.revision,
        split=recording.split,
        cameras=scene.cameras,
        rate_hz=scene.rate_hz,
        n_ticks=scene.n_ticks,
        radiance_gain=scene.radiance_gain,
        budget=request.budget.label,
        device=request.device,
        fit_seconds=0.0,
        harness=harness(),
        created=utc_now(),
    )


def _key(about: Provenance) -> str:
    """Return the content key of a fit: everything that decides what comes out."""
    names = "method", "scene", "scene_revision", "split", "budget"
    return sha256_json({**{n: getattr(about, n) for n in names}, "device": device_type(about.device)})


def _write_video(path: Path, saved: SavedModel) -> float:
    """Write the clip along an orbit, and return how many times slower than the world it is."""
    about, view = saved.provenance, orbit(saved.provenance.cameras)
    slow_motion = VIDEO_S * 1e6 / about.duration_us
    first = resized(view(0.0), SCALE)
    start = time.perf_counter()
    image = saved.model.render(first, 0.0)
    fps = FPS if time.perf_counter() - start < SLOW_FRAME_S else SLOW_FPS
    height, width = (n // 2 * 2 for n in image.shape)  # of `first`, or the model's own where it follows no camera's
    with video_writer(path, (width, height), fps, gray=True) as write:
        for frame in render_frames(saved, view, frame_times(about.duration_us, slow_motion, fps), SCALE):
            write(frame[:height, :width])
    return slow_motion


@contextmanager
def _timed(times: dict[str, float], step: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    times[step] = time.perf_counter() - start


def _say(console: Console, text: str) -> None:
    console.print(text, highlight=False, markup=False)
