"""Which pixels of a held-out camera can be known: what two or more training cameras see, by the scene's depth maps.

A corner that no training camera sees has whatever a model guesses there, and 20 such pixels of 25,000 can hold half of
an image's squared error. Gao et al. (Monocular dynamic view synthesis: a reality check, NeurIPS 2022) leave such pixels
out as not co-visible, and find them by optical flow; here depth tells them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64, Mask
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import read_geometry
from spike4dgs.benchmark.scene.scene import Scene

_DEPTH = re.compile(r"geometry/([^/]+)/(\d+)\.exr")
CAMERAS = 2  # that have to see a point: one tells no depth
_TOLERANCE = 0.02  # of a depth: between the four pixels around a point the surface may bend
_SKY_M = 1e6  # where a pixel without a surface is put,
_FAR_M = 1e4  # and the depth above which all count as equal: the axes of two cameras differ


def covisible(scene: Scene) -> dict[str, Mask] | None:
    """Return, by held-out camera, the pixels [H, W] whose resting surface at least two training cameras see.

    A camera's resting scene is the farthest that it sees at any instant: what moves hides it for a time. A scene
    without depth of all these cameras at some instant, such as a recording, has none; None where files of it cannot be
    read.
    """
    cameras = (*scene.train, *scene.test)
    found = [match.groups() for match in map(_DEPTH.fullmatch, scene.manifest.files) if match]
    ticks = set.intersection(*({tick for name, tick in found if name == camera} for camera in cameras))
    if not ticks:
        return {}
    try:
        depth = {camera: _resting_depth(scene, camera, sorted(ticks)) for camera in cameras}
    except UserError:  # no other metric needs them
        return None
    seen_by = {scene.cameras[camera]: depth[camera] for camera in scene.train}
    return {camera: count_views(scene.cameras[camera], depth[camera], seen_by) >= CAMERAS for camera in scene.test}


def count_views(camera: Camera, depth: Float32, others: Mapping[Camera, Float32]) -> Float64:
    """Return how many other cameras see what each pixel of a camera shows, [H, W].

    depth: along the camera's optical axis at the middle of its pixels [H, W], inf where there is nothing; others: the
    same of each other camera.
    """
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    points = camera.unproject(np.stack([u.ravel(), v.ravel()], -1), np.minimum(depth, _SKY_M).ravel().astype(float))
    counts = np.sum([_sees(other, found, points) for other, found in others.items()], axis=0, dtype=np.float64)
    return np.asarray(counts).reshape(depth.shape)


def _sees(camera: Camera, depth: Float32, points: Float64) -> Mask:
    """Return which points [N, 3] a camera sees: their depth is within that of the four pixels around them, [N]."""
    uv, z = camera.project(points)
    size = camera.width, camera.height
    with np.errstate(invalid="ignore"):  # NaN: the lens shows no such point
        inside = (z > 0) & (uv >= 0).all(axis=1) & (uv <= size).all(axis=1)
    first = np.floor(uv[inside] - 0.5).astype(np.int64)
    around = [
        np.minimum(depth[tuple(np.clip(first + step, 0, np.subtract(size, 1)).T[::-1])], _FAR_M)
        for step in ((0, 0), (1, 0), (0, 1), (1, 1))
    ]
    found, at = inside.copy(), np.minimum(z[inside], _FAR_M)
    found[inside] = (np.min(around, 0) * (1 - _TOLERANCE) <= at) & (at <= np.max(around, 0) * (1 + _TOLERANCE))
    return found


def _resting_depth(scene: Scene, name: str, ticks: Sequence[str]) -> Float32:
    camera, found = scene.cameras[name], []
    for path in (scene.manifest.path(f"geometry/{name}/{tick}.exr") for tick in ticks):
        found.append(read_geometry(path).depth)
        if found[-1].shape != (camera.height, camera.width):
            expected = f"depth of {camera.width}x{camera.height} pixels"
            raise problem(path, expected, f"shape {found[-1].shape}", "make the scene again")
    return np.asarray(np.max(found, axis=0))
