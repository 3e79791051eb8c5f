"""One cell of the benchmark: fit one method on one scene, render the targets, write the predictions folder.

The predictions are what a run keeps and resumes by; scores are always computed again from the files.
"""

from __future__ import annotations

import shutil
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.environment import (
    device_type,
    environment,
    harness,
    peak_memory_mb,
    reset_peak_memory,
    utc_now,
)
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import read_json, sha256_json, write_json
from spike4dgs.benchmark.method import Budget, FitRequest, Method, Model, Progress, check_protocol, training_for
from spike4dgs.benchmark.runs.method_code import code_of
from spike4dgs.benchmark.runs.predictions import INFO, MethodInfo, PredictionInfo, PredictionWriter, open_predictions
from spike4dgs.benchmark.runs.provenance import Provenance, Savable
from spike4dgs.benchmark.runs.record import PROTOCOL
from spike4dgs.benchmark.runs.refinement import SUFFIX, Refinable, refined_cameras, views_of
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import Scene, Target, TrainingScene
from spike4dgs.benchmark.weights import WeightsError


@dataclass(frozen=True)
class Job:
    """A method on a scene, and everything that decides what comes out."""

    method: Method
    scene: Scene
    seed: int
    device: str
    budget: Budget
    refined: bool | None = None  # whether held-out cameras are refined besides; None: as the method asks

    @property
    def info(self) -> MethodInfo:
        """The method as records name it."""
        m = self.method
        version = getattr(m, "version", None) or harness()["version"]
        given = None if (found := getattr(m, "given", None)) is None else tuple(found)
        trained_on, oracle = (tuple(getattr(m, name, ())) for name in ("trained_on", "oracle"))
        return MethodInfo(m.name, version, dict(m.params), self.seed, trained_on, given, oracle)

    @property
    def variants(self) -> tuple[MethodInfo, ...]:
        """The method as it is, and with refined held-out cameras where that is asked for: one record each."""
        refined = replace(self.info, name=self.method.name + SUFFIX)
        asked = getattr(self.method, "refines_views", False) if self.refined is None else self.refined
        has_streams = set(self.scene.test) <= set(self.scene.meta["streams"])  # refinement needs them
        return (self.info, refined) if asked and has_streams else (self.info,)

    @property
    def key(self) -> str:
        """The content key under which predictions are found again; it covers the code of other packages' methods."""
        return self.key_on(self.scene.id, self.scene.revision)

    def key_on(self, scene: str, revision: str) -> str:
        """Return the key of this job on another scene, by its id and revision, with the same split."""
        code = {"code": found} if (found := code_of(self.method)) else {}
        method = {"method": replace(self.info, given=None).as_dict(), "harness": harness()["version"]}
        where = {"scene": scene, "revision": revision, "split": self.scene.split}
        fit = {"protocol": PROTOCOL, "budget": self.budget.label, "device": device_type(self.device)}
        return sha256_json({**code, **method, **where, **fit})


def is_done(job: Job, folder: Path) -> bool:
    """Return whether `folder` holds this job's predictions, whole and undamaged."""
    if not (folder / INFO).is_file():
        return False
    try:
        predictions = open_predictions(folder, job.scene.targets)
        predictions.verify()
    except UserError:
        return False  # damaged since: made again
    return _is_of(job, predictions.info)


def why_not_kept(job: Job, folder: Path) -> str | None:
    """Return why whole predictions that lie in `folder` are of another fit than this job's; None without such."""
    try:
        info = open_predictions(folder, job.scene.targets).info
    except UserError:
        return None
    if info.key is None or _is_of(job, info):
        return None
    mine, theirs, scene = job.info, info.method, job.scene
    differs = {
        "version": mine.version != theirs.version,
        "seed": mine.seed != theirs.seed,
        "trained_on": mine.trained_on != theirs.trained_on,
        "given": theirs.given not in (None, mine.given),
        "settings": mine.params != theirs.params,
        "revision of the scene": scene.revision != info.scene_revision,
        "split": scene.split != info.split,
        "budget": job.budget.label != info.budget,
        "device": device_type(job.device) != device_type(info.device or ""),
    }
    return "another " + (", ".join(what for what, other in differs.items() if other) or "code of the method")


def _is_of(job: Job, info: PredictionInfo) -> bool:
    """Return whether predictions are of this job; the key leaves out what was given, which older ones do not state."""
    return info.key == job.key and info.method.given in (None, job.info.given)


@dataclass(frozen=True)
class Failure:
    """The end of a cell without predictions."""

    status: str  # failed or skipped
    reason: str
    traceback: str


class FitFailed(Exception):
    """The failure of a method in another process."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.reason)
        self.failure = failure


def failure_of(error: Exception) -> Failure:
    """Return the failure that an exception means. Call it where the exception is handled."""
    if isinstance(error, FitFailed):
        return error.failure
    if isinstance(error, WeightsError):
        return Failure("skipped", error.reason, traceback.format_exc())  # records travel: no paths of this machine
    said = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}", traceback.format_exc()
    return Failure("failed", *(text.encode(errors="backslashreplace").decode() for text in said))  # may name any file


def run_job(
    job: Job, folders: Sequence[Path], model_path: Path, work: Path, progress: Progress, note: Callable[[str], None]
) -> None:
    """Fit, save the model to `model_path` if it can be saved, and render the predictions of the job's variants.

    They go to `folders`; `work` holds the checkpoint until these are whole. Only the fit sees `scene.training`;
    held-out cameras appear only in the calls to render, and refined ones are found after the fit. All of it happens in
    this process: `apart.fit_apart` does the same in one that sees the training part alone.
    """
    scene, request = job.scene, FitRequest(job.budget, job.device, job.seed, progress)
    model, fit_seconds = timed_fit(job.method, training_for(job.method, scene.training), request, work, note)
    if isinstance(model, Savable):
        model.save(model_path, provenance_of(job, fit_seconds))
    cameras = scene.cameras
    for method, folder in zip(job.variants, folders, strict=True):
        if method != job.info:
            cameras = {**cameras, **refined_cameras(cast(Refinable, model), views_of(scene))}
        with PredictionWriter(folder) as writer:
            costs = render_targets(model, scene, cameras, f"{method.name} on {scene.id}", job.device, writer.add)
            writer.finish(prediction_info(job, method, {**costs, "fit_seconds": fit_seconds}))
    shutil.rmtree(work)


def timed_fit(
    method: Method, scene: TrainingScene, request: FitRequest, work: Path, note: Callable[[str], None]
) -> tuple[Model, float]:
    """Return a fitted model and the seconds of its fit, all parts of a killed one included.

    `work` holds the checkpoint, from which a killed fit resumes. Compiling is no part of the fit.
    """
    work.mkdir(parents=True, exist_ok=True)
    checkpoint = work / "checkpoint.safetensors"
    check_protocol(method, type(method).__module__)
    request = replace(request, checkpoint=checkpoint)
    if warm_up := getattr(method, "warm_up", None):
        warm_up(request)
    reset_peak_memory(request.device)
    clock = FitClock(work / "fit_clock.json", checkpoint)
    if clock.resumes:
        note(f"resuming after {clock.before:.0f} s of fitting")
    model = method.fit(scene, replace(request, progress=clock.watched(request.progress)))
    return model, clock.seconds()


def render_targets(
    model: Model,
    scene: Scene,
    cameras: Mapping[str, Camera],
    where: str,
    device: str,
    add: Callable[[Target, Float32, float], None],
) -> dict[str, float | None]:
    """Render the scene's targets as `cameras` see them, hand each image and its time in us to `add`, return the costs.

    `where` names it in errors. The costs are those of `COSTS` but for `fit_seconds`; one rendering before is uncounted.
    """
    render_seconds, size = 0.0, getattr(model, "size_bytes", None)
    for n, target in enumerate((*scene.targets[:1], *scene.targets)):
        camera, t_us = cameras[target.camera], scene.t_us(target.tick)
        start = time.perf_counter()
        image = _render(model, camera, t_us, f"{where}, {target.name}")
        if n:  # the one before may import and compile
            render_seconds += time.perf_counter() - start
            add(target, image, t_us)
    return {
        "render_fps": len(scene.targets) / render_seconds,
        "peak_memory_mb": peak_memory_mb(device),
        "model_mb": None if size is None else int(size) / 1e6,
    }


def prediction_info(job: Job, method: MethodInfo, costs: Mapping[str, float | None]) -> PredictionInfo:
    """Return what prediction.json says of the predictions of one of the job's variants."""
    return PredictionInfo(
        method=method,
        scene=job.scene.id,
        scene_revision=job.scene.revision,
        split=job.scene.split,
        budget=job.budget.label,
        device=job.device,
        environment=environment(job.device),
        harness=harness(),
        key=job.key,
        created=utc_now(),
        **costs,
    )


def provenance_of(job: Job, fit_seconds: float) -> Provenance:
    """Return the provenance that is saved with the model of a job."""
    scene = job.scene
    return Provenance(
        method=job.info.as_dict(),
        scene=scene.id,
        scene_revision=scene.revision,
        split=scene.split,
        cameras=scene.training.cameras,
        rate_hz=scene.rate_hz,
        n_ticks=scene.n_ticks,
        radiance_gain=scene.radiance_gain,
        budget=job.budget.label,
        device=job.device,
        fit_seconds=fit_seconds,
        harness=harness(),
        created=utc_now(),
    )


def _render(model: Model, camera: Camera, t_us: float, where: str) -> Float32:
    image: Any = model.render(camera, t_us)
    shape = (camera.height, camera.width)
    if not isinstance(image, np.ndarray) or image.shape != shape or not np.issubdtype(image.dtype, np.floating):
        kind = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise problem(where, f"a floating-point array of shape {shape}", kind, "correct the method's render")
    if not np.isfinite(image).all():
        raise problem(where, "finite radiance", "NaN or infinity", "correct the method's fit or render")
    return image.astype(np.float32)


class FitClock:
    """Seconds that went into a fit, over all its parts when it was killed and resumed.

    A small file holds the seconds up to the last checkpoint; work after that is lost, done again, and counted then. A
    new checkpoint is noticed at the fit's next report of its progress. No wall clock is read: those may be moved.
    """

    def __init__(self, path: Path, checkpoint: Path) -> None:
        self._path, self._checkpoint = path, checkpoint
        self.before = 0.0
        self.resumes = path.is_file() and checkpoint.is_file()
        if self.resumes:
            self.before = float(read_json(path, "the times of an unfinished fit")["seconds"])
        self._seen, self._start = self._version(), time.perf_counter()
        write_json(path, {"seconds": self.before})

    def seconds(self) -> float:
        """Seconds of all parts up to now."""
        return self.before + time.perf_counter() - self._start

    def watched(self, progress: Progress) -> Progress:
        """Return a receiver that passes progress on, and keeps the seconds of a new checkpoint."""

        def report(done: int, total: int, note: str = "") -> None:
            if (version := self._version()) != self._seen:
                self._seen = version
                write_json(self._path, {"seconds": self.seconds()})
            progress(done, total, note)

        return report

    def _version(self) -> int | None:
        return self._checkpoint.stat().st_mtime_ns if self._checkpoint.is_file() else None
