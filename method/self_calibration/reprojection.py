"""Whether cameras fit points that were marked in their images.

A point is triangulated from all cameras that see it and projected into each of them; and, where three or more see it,
triangulated from the others alone and projected into the one left out. The second tells what a camera's own marks hide
in the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float64, Int64
from spike4dgs.benchmark.exchange.marked_points import MarkedPoints
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.self_calibration.pose_adjustment import Tracks, triangulated


@dataclass(frozen=True, eq=False)
class Reprojection:
    """Errors in px of a camera's marks: of points from all cameras, and of points from the others alone."""

    together: Float64  # [N]
    left_out: Float64  # [M], of points that at least two others see


def reprojection(cameras: Sequence[Camera], marked: MarkedPoints) -> dict[str, Reprojection]:
    """Return the errors of each camera by name. Marks of other cameras, and points that one camera sees, count not."""
    tracks = _tracks(cameras, marked)
    together = _errors(cameras, tracks, triangulated(cameras, _straight(cameras, tracks)))
    times = np.bincount(tracks.point, minlength=tracks.points)
    found = {}
    for i, camera in enumerate(cameras):
        mine = tracks.camera == i
        asked = Tracks(*(part[mine & (times[tracks.point] > 2)] for part in (tracks.camera, tracks.point, tracks.uv)))
        others = Tracks(*(part[~mine] for part in (tracks.camera, tracks.point, tracks.uv)))
        points = np.zeros((tracks.points, 3))
        if len(others.uv):
            found_points = triangulated(cameras, _straight(cameras, others))
            points[: len(found_points)] = found_points
        found[camera.id] = Reprojection(together[mine], _errors(cameras, asked, points))
    return found


def _tracks(cameras: Sequence[Camera], marked: MarkedPoints) -> Tracks:
    """Return the observations of points that two or more of the cameras see."""
    number = {c.id: i for i, c in enumerate(cameras)}
    known = [i for i, camera in enumerate(marked.camera) if camera in number]
    times: dict[tuple[str, str], int] = {}
    for i in known:
        times[marked.of[i]] = times.get(marked.of[i], 0) + 1
    kept = [i for i in known if times[marked.of[i]] > 1]
    points = {of: k for k, of in enumerate(dict.fromkeys(marked.of[i] for i in kept))}
    camera: Int64 = np.array([number[marked.camera[i]] for i in kept], np.int64)
    return Tracks(camera, np.array([points[marked.of[i]] for i in kept], np.int64), marked.uv[kept])


def _straight(cameras: Sequence[Camera], tracks: Tracks) -> Tracks:
    """Return the observations as pinholes of the same K would see them; NaN never: outside of a lens the mark stays."""
    uv = tracks.uv.copy()
    for i, camera in enumerate(cameras):
        mine = tracks.camera == i
        if camera.distortion and mine.any():
            straight = camera.normalized(uv[mine]) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
            uv[mine] = np.where(np.isfinite(straight), straight, uv[mine])
    return Tracks(tracks.camera, tracks.point, uv)


def _errors(cameras: Sequence[Camera], tracks: Tracks, points: Float64) -> Float64:
    """Return the distances [N] px of observations from the projections of their points."""
    errors = np.full(len(tracks.uv), np.inf)
    for i, camera in enumerate(cameras):
        mine = tracks.camera == i
        if mine.any():
            uv, z = camera.project(points[tracks.point[mine]])
            errors[mine] = np.where(z > 0, np.linalg.norm(uv - tracks.uv[mine], axis=1), np.inf)
    return errors
