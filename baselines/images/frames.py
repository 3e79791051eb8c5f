"""Images of other sensors: the frames of a conventional camera, and instants from its frames and events.

`rgb` are the frames as they are, each at the middle of its exposure. `edi` is the Event-based Double Integral (Pan et
al., CVPR 2019). A pixel's radiance follows its events, L(s) = L(t) exp(c (E(s) - E(t))), with E the sum of their
polarities and c the threshold. A frame B is the mean of L over its exposure, so that

    L(t) = B exp(c E(t)) / mean over the exposure of exp(c E(s)).

E is constant between events: the mean is a finite sum, and not sampled. Of several frames that of the nearest middle
serves; beyond its exposure the events carry on. The paper estimates c by the sharpness of edges; here the scene states
it, as it states the exposure. What a frame clips stays clipped.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64, Int64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.images import GRAY
from spike4dgs.benchmark.scene.other_sensors import EventStream, Frames
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.images.recorded import Recorded, RecordedImages


def frame_images(scene: TrainingScene, ticks: Sequence[int] = ()) -> Recorded:
    """Return all frames of the training cameras with their exposures, at their own times, whatever `ticks` are.

    Raises UserError where a camera has no frames, or has them at other times than the first.
    """
    first, *others = (scene.frames(camera.id) for camera in scene.cameras)
    for other in others:
        if (other.ticks, other.exposure_us) != (first.ticks, first.exposure_us):
            found = f"others at {other.camera}"
            raise problem(scene.id, f"frames at the times of {first.camera}", found, "use a scene of cameras in sync")
    images = np.stack([[_gray(f, i) for f in (first, *others)] for i in range(len(first))])
    return Recorded(_middles(first), images, first.exposure_ticks)


def edi_images(scene: TrainingScene, ticks: Sequence[int]) -> Recorded:
    """Return the images at `ticks` by EDI. Raises UserError where a camera has no frames or no events."""
    return Recorded(
        tuple(ticks),
        np.stack([edi(scene.frames(c.id), scene.events(c.id), ticks) for c in scene.cameras], axis=1),
    )


def edi(frames: Frames, events: EventStream, ticks: Sequence[int]) -> Float32:
    """Return radiance [n, H, W] at the starts of ascending `ticks` from a camera's frames and events."""
    (height, width), tick_us, found = frames.shape, 1e6 / frames.rate_hz, events.events
    pixels = found.y.astype(np.int64) * width + found.x
    changes = np.where(found.p > 0, 1, -1) * events.threshold
    nearest = np.abs(np.array(ticks)[:, None] - _middles(frames)).argmin(axis=1)

    def change(start_us: float, stop_us: float) -> Float64:
        """Return c (E(stop) - E(start)) of each pixel."""
        a, b = np.searchsorted(found.t, sorted((start_us, stop_us)))
        total = np.bincount(pixels[a:b], weights=changes[a:b], minlength=height * width)
        return np.asarray(total if stop_us >= start_us else -total, np.float64)

    images = np.empty((len(ticks), height, width), np.float32)
    for i in sorted(set(nearest.tolist())):
        at_us, length_us = frames.ticks[i] * tick_us, frames.exposure_ticks * tick_us
        a, b = np.searchsorted(found.t, [at_us, at_us + length_us])
        mean = exposure_mean(pixels[a:b], changes[a:b], (found.t[a:b] - at_us) / length_us, height * width)
        frame, log = _gray(frames, i), -np.log(mean)  # of the instant over the frame
        for k in np.flatnonzero(nearest == i).tolist():
            log += change(at_us, ticks[k] * tick_us)
            at_us = ticks[k] * tick_us
            images[k] = frame * np.exp(log).reshape(height, width)
    return images


def exposure_mean(pixels: Int64, changes: Float64, times: Float64, size: int) -> Float64:
    """Return the mean over an exposure of exp(c E) [size], with E = 0 at its start.

    pixels, changes, times: of the events in order of time: pixel, +c or -c, and share of the exposure before it.
    """
    order = np.argsort(pixels, kind="stable")
    p, change, t = pixels[order], changes[order], times[order]
    new = np.diff(p, prepend=-1) != 0  # a pixel's first event
    last = np.diff(p, append=size) != 0
    sums = np.cumsum(change)
    level = sums - (sums - change)[np.flatnonzero(new)][np.cumsum(new) - 1]  # c E after each event
    until = np.where(last, 1.0, np.append(t[1:], 1.0)[: len(p)])
    return np.asarray(1 + np.bincount(p, weights=np.expm1(level) * (until - t), minlength=size))


def _middles(frames: Frames) -> tuple[int, ...]:
    return tuple(tick + frames.exposure_ticks // 2 for tick in frames.ticks)


def _gray(frames: Frames, index: int) -> Float32:
    image = frames[index].radiance
    return image if image.ndim == 2 else image @ np.array(GRAY, np.float32)


RGB = RecordedImages(
    name="rgb",
    definition="frames of a conventional camera, at the middle of their exposures",
    given=("frames",),
    read=frame_images,
    label="of a conventional camera",
)
EDI = RecordedImages(
    name="edi",
    definition="frame x exp(c E(t)) / mean over its exposure of exp(c E), E the events' sum",
    source="Pan, Scheerlinck, Yu, Hartley, Liu, Dai: Bringing a blurry frame alive at high frame-rate with an event "
    "camera, CVPR 2019",
    given=("frames", "events"),
    read=edi_images,
    label="by EDI of frames and events",
)
RECORDED = (RGB, EDI)
