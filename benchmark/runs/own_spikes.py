"""The held-out cameras' own spikes, for the metrics that judge predictions by them."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from spike4dgs.benchmark.errors import UserError
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
from spike4dgs.benchmark.metrics.metric import Metric
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.scene.scene import Scene, Target
from spike4dgs.benchmark.spikes.stream import SpikeStream

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
    if not any(_of_spikes(m) for m in selection.metrics):
        return cameras, selection
    for name in dict.fromkeys(t.camera for t in targets):
        camera = scene.cameras[name]
        try:
            response = response_of(scene.recordings(name), (camera.height, camera.width), scene.radiance_gain)
            cameras[name] = HeldOutCamera(scene.stream(name), response)
        except UserError:  # the message has a path of this machine, and records travel
            return {}, selection.without(SPIKE_METRICS, f"the stream or the recordings of {name} cannot be read")
    return cameras, selection


def without_truth(selection: Selection) -> Selection:
    """Return the selection without the metrics that compare with the truth."""
    compared = [m.id for m in selection.metrics if not (_of_spikes(m) or m.blind)]
    return selection.without(compared, "the scene has no ground truth")


def _of_spikes(metric: Metric) -> bool:
    return metric.takes == "spikes"


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
