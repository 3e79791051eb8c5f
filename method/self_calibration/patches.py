"""Small squares of the views that an array of cameras sees together: where they are, and what each camera sees there.

An image is the mean rate of a window of ticks, blurred a little: the spikes' quantisation is white, and what moves is
not. Windows are whole: a time whose window leaves the clip or touches a gap has no image. Pixels that say nothing are
NaN, and so is what the blur takes from them.

A patch belongs to a view and a time of the array. It is a piece of a plane: its inverse depth in that view is linear in
the pixel. The slants matter: where depth and velocity both change along a patch, as on a turntable, one depth for all
of it would look like a difference of time. A point at pixel x of view r is seen by view c at K_c (R d + w t), with the
ray d = K_r^-1 x, the inverse depth w and the pose (R, t) of c relative to r: smooth in w, at infinity too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64, Int64
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.camera_state import CameraState
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.lens import resample
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.sensor_model import gathered
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.training_views.pinholes import Lens, lenses_of


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
    rate: Float32 = gathered(stream.counts(start, stop) / (stop - start), stream.dead_ticks).astype(np.float32)
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


STRIDE_PX = 2.0  # between a patch's points: after a blur of 1 px their noise is nearly independent
_GRID = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(-1, 2)
POINTS = len(_GRID)  # of a patch
BASIS = np.column_stack([np.ones(POINTS), STRIDE_PX * _GRID])  # [K, 3] of a patch's inverse depths
CAP = 0.1  # of a difference of radiance in a sweep: beyond, a camera sees something else


@dataclass(frozen=True, eq=False)
class Patches:
    """P patches at one time of the array."""

    view: Int64  # [P]
    center: Float64  # [P, 2] px
    surface: Float64  # [P, 3] inverse depth of the middle, 1/m, along the view's axis; its change by column and by row

    def __len__(self) -> int:
        return len(self.view)

    @property
    def inverse(self) -> Float64:
        """Inverse depths of the points [P, K]."""
        return self.surface @ BASIS.T


@dataclass(frozen=True, eq=False)
class Rays:
    """The points of P patches as a camera sees them, for any inverse depth w: uv ~ far + w near, homogeneous."""

    far: Float64  # [P, K, 3]
    near: Float64  # [P, 1, 3]

    def project(self, inverse: Float64) -> tuple[Float64, Float64]:
        """Return pixels [P, K, 2] at inverse depths [P, K], NaN behind the camera, and their derivatives by them."""
        p = self.far + inverse[..., None] * self.near
        z = np.where(p[..., 2:] > 1e-6, p[..., 2:], np.nan)
        uv = p[..., :2] / z
        return uv, (self.near[..., :2] - uv * self.near[..., 2:]) / z


def rays(cameras: Sequence[Camera], patches: Patches, camera: Camera) -> Rays:
    """Return the points of patches as `camera` sees them."""
    R = camera.R @ np.stack([c.R.T for c in cameras])
    t = camera.t - np.einsum("cij,cj->ci", R, np.stack([c.t for c in cameras]))
    to_ray = R @ np.linalg.inv(np.stack([c.K for c in cameras]))
    pixels = patches.center[:, None] + STRIDE_PX * _GRID
    homogeneous = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=-1)
    far = np.einsum("pij,pkj->pki", camera.K @ to_ray[patches.view], homogeneous)
    return Rays(far, (t[patches.view] @ camera.K.T)[:, None])


@dataclass(frozen=True, eq=False)
class Observed:
    """The radiance of points in all cameras with its derivatives: each [P, K, C], NaN where a camera does not see."""

    value: Float64
    x_by_inverse: Float64  # px m: of the point's pixel by the inverse depth
    y_by_inverse: Float64
    by_x: Float64
    by_y: Float64
    by_time: Float64


def observe(
    cameras: Sequence[Camera], moments: Sequence[Moment | None], patches: Patches, shift: Float64 | None = None
) -> Observed:
    """Return what each camera's moment shows of the patches; `shift` [C, 2] px moves all that a camera sees."""
    shape = (len(patches), POINTS, len(cameras))
    found = np.full((6, *shape), np.nan)
    for c, (camera, moment) in enumerate(zip(cameras, moments, strict=True)):
        if moment is None:
            continue
        uv, by_inverse = rays(cameras, patches, camera).project(patches.inverse)
        moved = uv if shift is None else uv + shift[c]
        value, x, y, time = look_up(moment.stack, moved.reshape(-1, 2)).reshape(4, *shape[:2])
        found[..., c] = value, by_inverse[..., 0], by_inverse[..., 1], x, y, time
    return Observed(*found)


def sweep(
    cameras: Sequence[Camera], moments: Sequence[Moment | None], patches: Patches, planes: Float64
) -> tuple[Float64, Float64]:
    """Return for each patch the inverse depth among `planes` [D] at which cameras differ least, and that difference.

    The difference is the mean of min(|difference to the patch's own view|, CAP) over the other cameras that see it;
    infinite where fewer than two do.
    """
    seen = [(c, m.image) for c, m in enumerate(moments) if m is not None]
    own = np.full((len(patches), POINTS), np.nan)
    total, count = np.zeros((len(planes), len(patches))), np.zeros((len(planes), len(patches)))
    for c, image in seen:
        mine = patches.view == c
        uv, _ = rays(cameras, patches, cameras[c]).project(patches.inverse)
        own[mine] = look_up(image, uv[mine].reshape(-1, 2)).reshape(-1, POINTS)
    for c, image in seen:
        lines = rays(cameras, patches, cameras[c])
        for d, plane in enumerate(planes):
            uv, _ = lines.project(np.full(own.shape, plane))
            value = look_up(image, uv.reshape(-1, 2)).reshape(own.shape)
            difference = np.minimum(np.abs(value - own), CAP).mean(axis=1)
            other = np.isfinite(difference) & (patches.view != c)
            total[d] += np.where(other, difference, 0.0)
            count[d] += other
    cost = np.where(count >= 2, total / np.maximum(count, 1), np.inf)
    best = cost.argmin(axis=0)
    return planes[best], cost[best, np.arange(len(patches))]


def strongest(score: Float64, least: float, cell_px: int, count: int) -> Float64:
    """Return the pixel centres [N, 2] of the largest scores [H, W] above `least`: one a cell, at most `count`.

    A margin of a patch's size is left out, and so are scores that are no number.
    """
    edge = int(STRIDE_PX) + 2
    usable = np.where(np.isfinite(score) & (score > least), score, -np.inf)
    usable[:edge], usable[-edge:], usable[:, :edge], usable[:, -edge:] = (-np.inf,) * 4
    height, width = (n // cell_px for n in score.shape)
    whole = usable[: height * cell_px, : width * cell_px].reshape(height, cell_px, width, cell_px)
    cells = whole.transpose(0, 2, 1, 3).reshape(height * width, -1)
    best = cells.argmax(axis=1)
    top = np.take_along_axis(cells, best[:, None], axis=1)[:, 0]
    chosen = np.argsort(-top, kind="stable")[:count]
    chosen = chosen[np.isfinite(top[chosen])]
    row, column = np.divmod(chosen, width)
    y, x = np.divmod(best[chosen], cell_px)
    return np.stack([column * cell_px + x, row * cell_px + y], axis=-1) + 0.5
