"""Small squares of the views that an array of cameras sees together: where they are, and what each camera sees there.

A patch belongs to a view and a time of the array. It is a piece of a plane: its inverse depth in that view is linear in
the pixel. The slants matter: where depth and velocity both change along a patch, as on a turntable, one depth for all
of it would look like a difference of time. A point at pixel x of view r is seen by view c at K_c (R d + w t), with the
ray d = K_r^-1 x, the inverse depth w and the pose (R, t) of c relative to r: smooth in w, at infinity too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.self_calibration.window_images import Moment, look_up

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

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
