"""Lenses that distort, as renderers take them: a row of ten numbers for each camera.

- k1, k2, p1, p2, k3: OpenCV's coefficients, see `benchmark.scene.lens`; zeros: a pinhole.
- x_low, x_high, y_low, y_high: what the image shows of the plane z = 1, and 0.3 of its half on each side.
- fold^2: the square of the radius in that plane beyond which nothing is seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from spike4dgs.benchmark.scene.cameras import Camera, border, check_lens
from spike4dgs.benchmark.scene.lens import Distortion, bend, fold_radius, make_distortion, slopes

FRUSTUM_MARGIN = 0.3  # the projection is linearised at most this fraction of the half image outside of it


def lens_rows(cameras: Sequence[Camera], device: torch.device | str) -> Tensor | None:
    """Return the lenses [C, 10] of cameras, float64; None where all are pinholes.

    Raises UserError for a lens whose model does not hold up to the image's corners.
    """
    if not any(c.distortion for c in cameras):
        return None
    rows = [_row(c.width, c.height, c.fx, c.fy, c.cx, c.cy, c.distortion) for c in cameras]  # the pose does not matter
    for camera, row in zip(cameras, rows, strict=True):
        if not np.isfinite(row[5:9]).all():
            check_lens(camera, "lens distortion")
    return torch.tensor(rows, dtype=torch.float64, device=device)


@lru_cache(maxsize=256)
def _row(width: int, height: int, fx: float, fy: float, cx: float, cy: float, lens: Distortion) -> tuple[float, ...]:
    camera = Camera("", width, height, fx, fy, cx, cy, np.eye(3), np.zeros(3), lens)
    seen = camera.normalized(border(camera))
    low, high = seen.min(axis=0), seen.max(axis=0)
    margin = FRUSTUM_MARGIN * 0.5 * (high - low)
    limits = np.stack([low - margin, high + margin], axis=-1)
    return (*(lens or (0.0,) * 5), *limits.flatten().tolist(), fold_radius(lens) ** 2 if lens else math.inf)


def bent(xy: Tensor, lenses: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lens's coordinates [..., 2] of a pinhole's [..., 2], and whether the lens shows them [...], bool.

    Beyond the fold, where the formula leads back into the image or mirrors it, nothing is seen. Lenses are [..., 10].
    """
    x, y = xy.unbind(-1)
    coefficients = lenses[..., :5].unbind(-1)
    xx, both, yy = slopes(x, y, coefficients)
    shown = (x * x + y * y < lenses[..., 9]) & (xx * yy > both * both)
    return torch.stack(bend(x, y, coefficients), -1), shown


def bent_slopes(xy: Tensor, lenses: Tensor) -> Tensor:
    """Return the derivatives [..., 2, 2] of the lens's coordinates in the pinhole's, which are symmetric."""
    x, y = xy.unbind(-1)
    xx, both, yy = slopes(x, y, lenses[..., :5].unbind(-1))
    return torch.stack([xx, both, both, yy], -1).reshape(*xx.shape, 2, 2)


def lens_rays(K: Tensor, lenses: Tensor, width: int, height: int) -> Tensor:
    """Return the float32 unit directions [C, 3, H * W] of the pixels' rays in the cameras' coordinates.

    K is [C, 3, 3], lenses are [C, 10]; the directions are on their device.
    """
    rows = zip(K.tolist(), lenses[:, :5].tolist(), strict=True)
    rays = [_rays(width, height, k[0][0], k[1][1], k[0][2], k[1][2], make_distortion(row)) for k, row in rows]
    return torch.stack(rays).to(lenses.device)


@lru_cache(maxsize=64)  # a fit asks for those of its cameras at each step
def _rays(width: int, height: int, fx: float, fy: float, cx: float, cy: float, lens: Distortion) -> Tensor:
    v, u = np.mgrid[:height, :width].reshape(2, -1) + 0.5
    xy = Camera("", width, height, fx, fy, cx, cy, np.eye(3), np.zeros(3), lens).normalized(np.stack([u, v], axis=-1))
    directions = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    return torch.from_numpy((directions / np.linalg.norm(directions, axis=1, keepdims=True)).T.astype(np.float32))
