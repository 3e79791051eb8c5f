"""First points for cameras that stand around their subject, as in a ring.

Such views share no distance from infinity on: each pair sees the same things only near the point at which all cameras
look, and the far side of the subject is hidden. A plane sweep through all views has nothing to match there. Points are
put at random into the volume that the images show around that point, as is usual for subjects that are filmed from
around (3D Gaussian splatting's start for the synthetic scenes of NeRF).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.scene.cameras import Camera

_WIDEST_DEG = 60.0  # between optical axes, up to which an array faces its scene; a lens with that field of view is wide
_POINTS_PER_PIXEL = 0.4  # of one image: as many as the plane sweep leaves


@dataclass(frozen=True, eq=False)
class Ball:
    """The volume that cameras look at."""

    center: Float64  # [3]
    radius: float


def looked_at(cameras: Sequence[Camera]) -> Ball | None:
    """Return the volume that cameras around a subject show, or None for an array that faces its scene.

    The centre is the point nearest to all optical axes, and the radius reaches as far as any image at its distance.
    """
    axes = np.stack([c.R[2] for c in cameras])
    if (axes @ axes.T).min() > np.cos(np.radians(_WIDEST_DEG)):
        return None
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    centers = np.stack([c.center for c in cameras])
    center = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centers), rcond=None)[0]
    distances = np.linalg.norm(centers - center, axis=1)
    if any((center - c.center) @ axis <= 0 for c, axis in zip(cameras, axes, strict=True)):
        return None  # they look outwards
    corners = [np.hypot(c.width / c.fx, c.height / c.fy) / 2 for c in cameras]
    return Ball(center, float(np.max(distances * corners)))


def points_inside(ball: Ball, cameras: Sequence[Camera], seed: int = 0) -> Float64:
    """Return random points [N, 3] of a ball, uniform in its volume, that two or more cameras see."""
    rng = np.random.default_rng(seed)
    wanted = int(_POINTS_PER_PIXEL * cameras[0].width * cameras[0].height)
    directions = rng.normal(size=(4 * wanted, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = ball.center + ball.radius * directions * rng.random((4 * wanted, 1)) ** (1 / 3)
    views = np.zeros(len(points), int)
    for c in cameras:
        uv, z = c.project(points)
        views += (z > 0) & (uv >= 0).all(1) & (uv[:, 0] < c.width) & (uv[:, 1] < c.height)
    return points[views >= 2][:wanted]
