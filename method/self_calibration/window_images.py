"""Images of one camera at a time of its own clock, with their derivatives, for the estimate of clocks.

An image is the mean rate of a window of ticks, blurred a little: the spikes' quantisation is white, and what moves is
not. Windows are whole: a time whose window leaves the clip or touches a gap has no image. Pixels that say nothing are
NaN, and so is what the blur takes from them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.camera_state import CameraState
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.lens import resample
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.training_views.pinholes import Lens, lenses_of

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Viewer:
    """A camera with its stream, the array's spikes per tick of white, and what is known of its response."""

    camera: Camera
    stream: SpikeStream
    radiance_gain: float
    calibration: Calibration | None
    state: CameraState
    lens: Lens | None = None  # through which the stream was taken; `camera` is then the pinhole in its place


def viewers(scene: TrainingScene) -> tuple[Viewer, ...]:
    """Return the training cameras of a scene; where lenses distort, one of `as_pinholes`."""
    calibrations: Sequence[Calibration | None] = scene.calibrations or (None,) * len(scene.cameras)
    lenses: Sequence[Lens | None] = lenses_of(scene) or (None,) * len(scene.cameras)
    return tuple(
        Viewer(camera, stream, scene.radiance_gain, calibration, scene.state(camera.id), lens)
        for camera, stream, calibration, lens in zip(scene.cameras, scene.streams, calibrations, lenses, strict=True)
    )


def window_image(viewer: Viewer, tick: int, half: int, blur_px: float) -> Float64 | None:
    """Return the radiance [H, W] of the ticks [tick - half, tick + half) of the camera; None where data lack."""
    stream = viewer.stream
    start, stop = tick - half, tick + half
    if start < 0 or stop > stream.n_ticks or not _whole(stream, start, stop):
        return None
    rate = (stream.counts(start, stop) / (stop - start)).astype(np.float32)
    found = viewer.calibration
    image = found.radiance(rate) if found else rate / np.float32(viewer.radiance_gain * viewer.state.gain)
    image = image.astype(np.float64)
    if found:
        image[~(found.gain > 0)] = np.nan
    if viewer.state.bad is not None:
        image[viewer.state.bad] = np.nan
    if viewer.lens:
        image = resample(image.astype(np.float32), viewer.lens.to_camera).astype(np.float64)
        image[~viewer.lens.seen] = np.nan
    return blurred(image, blur_px)


def _whole(stream: SpikeStream, start: int, stop: int) -> bool:
    return not stream.gaps or bool(present(stream.gaps, stream.n_ticks)[start:stop].all())


def blurred(image: Float64, sigma: float) -> Float64:
    """Return an image blurred by a Gaussian of `sigma` px, over the pixels that are numbers; NaN where few are."""
    known = np.isfinite(image)
    if known.all():
        return _gaussian(image, sigma)
    weight = _gaussian(known.astype(np.float64), sigma)
    total = _gaussian(np.where(known, image, 0.0), sigma)
    return np.where(weight > 0.5, total / np.maximum(weight, 0.5), np.nan)


def _gaussian(image: Float64, sigma: float) -> Float64:
    if sigma <= 0:
        return image
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT), np.float64)


@dataclass(frozen=True, eq=False)
class Moment:
    """An image at a time, and its derivatives by column, row (per px) and time (per tick), each [H, W]."""

    image: Float64
    by_x: Float64
    by_y: Float64
    by_time: Float64

    @property
    def stack(self) -> Float64:
        """All four, [4, H, W]."""
        return np.stack([self.image, self.by_x, self.by_y, self.by_time])


def moment(viewer: Viewer, time: float, half: int, blur_px: float) -> Moment | None:
    """Return the image at a real-valued tick of the camera, interpolated between two; None where data lack.

    The derivatives are central differences: their noise is not that of the image, which a fit by them relies on.
    """
    first, reach = math.floor(time), max(1, half // 2)
    ticks = (first, first + 1, first - reach, first + 1 + reach)
    images = [window_image(viewer, t, half, blur_px) for t in ticks]
    if any(image is None for image in images):
        return None
    before, after, early, late = (np.asarray(image) for image in images)
    image = before + (time - first) * (after - before)
    by_x, by_y = np.full_like(image, np.nan), np.full_like(image, np.nan)
    by_x[:, 1:-1] = 0.5 * (image[:, 2:] - image[:, :-2])
    by_y[1:-1] = 0.5 * (image[2:] - image[:-2])
    return Moment(image, by_x, by_y, (late - early) / (1 + 2 * reach))


def look_up(stack: Float64, uv: Float64) -> Float64:
    """Return the bilinear values [..., N] of images [..., H, W] at pixel coordinates uv [N, 2]; NaN outside."""
    height, width = stack.shape[-2:]
    x, y = uv[:, 0] - 0.5, uv[:, 1] - 0.5
    inside = (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)
    i, j = x.astype(np.int64), y.astype(np.int64)
    a, b = x - i, y - j
    flat, at = stack.reshape(*stack.shape[:-2], -1), j * width + i
    top = (1 - a) * flat[..., at] + a * flat[..., at + 1]
    bottom = (1 - a) * flat[..., at + width] + a * flat[..., at + width + 1]
    return np.where(inside, (1 - b) * top + b * bottom, np.nan)
