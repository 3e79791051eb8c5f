"""What a held-out camera is scored on: its targets, and its own spikes for the metrics that judge by them."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.metrics.held_out_spikes import (
    WINDOWS,
    Response,
    SpikeView,
    record_around,
    response_of,
    view_spikes,
)
from spike4dgs.benchmark.metrics.image_pair import Image
from spike4dgs.benchmark.metrics.measure import Selection
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.scene.scene import Scene, Target
from spike4dgs.benchmark.spikes.stream import SpikeStream

EVERY_MS = 1.0  # between the ticks of a recording without targets, as in made scenes,
MOST = 32  # and of each held-out camera's; longer clips have as many, evenly spread


def targets_of(scene: Scene) -> tuple[Target, ...]:
    """Return the scene's targets; where it lists none, every millisecond of each held-out camera.

    The ticks lie strictly inside the clip, and are at most `MOST`. Raises UserError where no camera is held out.
    """
    if scene.targets:
        return scene.targets
    if not scene.test:
        fix = "hold out a camera: --held-out of `spike4dgs record`, or the splits in scene.json"
        raise problem(scene.root, "a held-out camera, or targets in targets.json", "neither", fix)
    every = max(1, round(scene.rate_hz * EVERY_MS * 1e-3))
    inside = range(every, scene.n_ticks - every + 1, every) or range(scene.n_ticks // 2, scene.n_ticks // 2 + 1)
    chosen = sorted({round(i) for i in np.linspace(0, len(inside) - 1, min(MOST, len(inside)))})
    ticks = [inside[i] for i in chosen]
    return tuple(Target(camera, tick) for camera in scene.test for tick in ticks)


def has_truth(scene: Scene) -> bool:
    """Return whether the scene has ground truth. One that lists targets may keep their images back."""
    return any(f"images/{t.name}.exr" in scene.manifest.files for t in scene.targets)


REACH = max(WINDOWS) // 2  # ticks from a target within which predictions of other ticks are used
SPIKE_METRICS = tuple(m.id for m in METRICS.values() if m.takes == "spikes")


@dataclass(frozen=True, eq=False)
class HeldOutCamera:
    """A held-out camera's stream and its response to light."""

    stream: SpikeStream
    response: Response


Cameras = dict[str, HeldOutCamera]


def open_cameras(scene: Scene, targets: Sequence[Target], selection: Selection) -> tuple[Cameras, Selection]:
    """Return the cameras of the targets, and the selection without the metrics of spikes where these cannot be read.

    No stream is read where the selection has no metric of spikes.
    """
    cameras: Cameras = {}
    if not any(m.takes == "spikes" for m in selection.metrics):
        return cameras, selection
    for name in dict.fromkeys(t.camera for t in targets):
        camera = scene.cameras[name]
        try:
            stream, size = scene.stream(name), (camera.height, camera.width)
            response = response_of(scene.recordings(name), size, scene.radiance_gain, stream.dead_ticks)
            cameras[name] = HeldOutCamera(stream, response)
        except UserError:  # the message has a path of this machine, and records travel
            return {}, selection.without(SPIKE_METRICS, f"the stream or the recordings of {name} cannot be read")
    return cameras, selection


def without_truth(selection: Selection) -> Selection:
    """Return the selection without the metrics that compare with the truth."""
    compared = [m.id for m in selection.metrics if m.takes != "spikes" and not m.blind]
    return selection.without(compared, "the scene has no ground truth")


def view_of(
    camera: HeldOutCamera,
    target: Target,
    targets: Sequence[Target],
    prediction: Callable[[Target], Image],
    truth: Callable[[Target], Image] | None,
) -> SpikeView:
    """Return a target beside the spikes around it. `targets` are all of its camera, in the order of time.

    Between targets the images change linearly, as far as the longest window sees; that stands for the motion in it.
    """
    ticks = [t.tick for t in targets]
    first = max(bisect_left(ticks, target.tick - REACH) - 1, 0)
    near = targets[first : bisect_right(ticks, target.tick + REACH) + 1]
    truths = None if truth is None else [truth(t) for t in near]
    recorded = record_around(camera.stream, target.tick, camera.response)
    return view_spikes(recorded, [t.tick for t in near], [prediction(t) for t in near], truths)
