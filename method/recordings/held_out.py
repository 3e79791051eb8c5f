"""The held-out cameras of a recording, rendered by the fitted model and judged by the spikes that they recorded.

No ground truth is read. The renders are a predictions folder, which `score` takes too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.measure import Values, scene_means, select_metrics
from spike4dgs.benchmark.runs.held_out import SPIKE_METRICS, targets_of
from spike4dgs.benchmark.runs.predictions import MethodInfo, PredictionInfo, PredictionWriter
from spike4dgs.benchmark.runs.score import open_for, score_scene
from spike4dgs.benchmark.scene.camera_state import Clock
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import Scene, TrainingScene
from spike4dgs.benchmark.spikes.repair import fill_gaps
from spike4dgs.method.models.saved_model import SavedModel
from spike4dgs.method.recordings.self_calibrated import LARGEST_ERROR_TICKS, light_changes
from spike4dgs.method.self_calibration.clocks import clock_of_another
from spike4dgs.method.self_calibration.poses import pose_of_another

SHOWN = tuple(metric for metric in SPIKE_METRICS if not metric.endswith("_dynamic"))  # no mask says what moves


@dataclass(frozen=True)
class HeldOutScores:
    """Means over the images of each held-out camera, and over all of them; and why a value is missing."""

    cameras: Mapping[str, Values]
    mean: Values
    images: Mapping[str, int]  # by camera
    notes: Mapping[str, str]  # by metric


@dataclass(frozen=True)
class HeldOutView:
    """The camera and the clock with which a held-out camera is rendered."""

    camera: Camera
    clock: Clock = Clock()


def held_out_views(scene: Scene, fitted: TrainingScene, changed: Sequence[str], seed: int) -> dict[str, HeldOutView]:
    """Return the views of the held-out cameras, beside the `fitted` scene, of which `changed` was estimated anew.

    Where that is "poses" or "clocks", a held-out camera's are estimated in the same way, from its own stream. Its clock
    stays as given where that does not tell it, and where its light changes; both do where its stream cannot be read,
    as in a training part.
    """
    views = {name: HeldOutView(scene.cameras[name]) for name in scene.test}
    for name, view in views.items() if changed else ():
        try:
            stream, recordings = fill_gaps(scene.stream(name)), scene.recordings(name)
        except UserError:
            continue
        if "poses" in changed:
            found = pose_of_another(fitted, view.camera, stream, recordings, seed)
            view = replace(view, camera=found)
        if "clocks" in changed and not light_changes([stream]):
            told = clock_of_another(fitted, view.camera, stream, recordings)
            if told.error_ticks <= LARGEST_ERROR_TICKS:
                view = replace(view, clock=told.clock)
        views[name] = view
    return views


def judge_held_out(saved: SavedModel, scene: Scene, views: Mapping[str, HeldOutView], folder: Path) -> HeldOutScores:
    """Render the held-out cameras into a predictions folder, and score it by their own spikes alone.

    A target's tick is the held-out camera's own: the model is rendered at the time of the array then.
    """
    about, targets = saved.provenance, targets_of(scene)
    with PredictionWriter(folder) as writer:
        for target in targets:
            view, t_us = views[target.camera], scene.t_us(target.tick)
            at_us = view.clock.shared(target.tick) * 1e6 / scene.rate_hz
            writer.add(target, saved.model.render(view.camera, at_us), t_us)
        writer.finish(
            PredictionInfo(
                method=MethodInfo(**{**about.method, "trained_on": tuple(about.method["trained_on"])}),
                scene=scene.id,
                scene_revision=scene.revision,
                split=scene.split,
                budget=about.budget,
                device=about.device,
                fit_seconds=about.fit_seconds,
                harness=about.harness,
                created=about.created,
            )
        )
    cell = score_scene(open_for(folder, scene), scene, select_metrics(SPIKE_METRICS), with_truth=False)
    of_camera = {
        camera: {name: values for name, values in cell["per_image"].items() if name.startswith(f"{camera}/")}
        for camera in dict.fromkeys(t.camera for t in targets)
    }
    means = {camera: scene_means(images) for camera, images in of_camera.items()}
    images = {camera: len(found) for camera, found in of_camera.items()}
    return HeldOutScores(means, cell["metrics"], images, {m: cell["notes"][m] for m in SHOWN if m in cell["notes"]})
