"""Cameras that move: functions of s in [0, 1], laid out from the training cameras.

The training cameras saw only one side of a scene, so every path stays among them: a circle around the scene would show
its back, which no view has seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import problem, unknown
from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.benchmark.scene.lens import NAMES, make_distortion

Path = Callable[[float], Camera]
PathName = Literal["orbit", "rig", "still"]
ALONE = 0.05  # radius of the orbit around a single camera, in distances to the focus
FAR = 5.0  # distance of the focus of cameras whose axes never meet, in radii of the array
CANCEL = 0.1  # length of a mean of unit axes below which they cancel, as of cameras that stand around a scene
PARALLEL = 1e-4  # smallest eigenvalue, per camera, below which axes count as parallel: about half a degree


def make_path(name: PathName, cameras: Sequence[Camera], camera: str | None = None) -> Path:
    """Return the path called `name`; `still` is the training camera `camera`, or the middle one."""
    if camera is not None and name != "still":
        raise problem("--camera", "--path still beside it", f"--path {name}", "leave one of them out")
    if name == "orbit":
        return orbit(cameras)
    return rig(cameras) if name == "rig" else fixed(cameras, camera)


def focus(cameras: Sequence[Camera]) -> Float64:
    """Return the point [3] that is nearest to all optical axes, the middle of the scene.

    It minimises sum |(I - d d^T) (x - c)|^2 over x. If the axes are parallel, or meet behind the array, it is a point
    on the mean axis, five of the array's radii away. Where axes cancel, the middle camera's counts as the mean.
    """
    centers, axes = np.stack([c.center for c in cameras]), np.stack([c.R[2] for c in cameras])
    facing = _agreeing(cameras, 2)
    middle, forward = (np.mean(vectors, axis=0) for vectors in ([c.center for c in facing], [c.R[2] for c in facing]))
    forward = forward / np.linalg.norm(forward)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # [C, 3, 3]
    total = across.sum(0)
    if np.linalg.eigvalsh(total)[0] > PARALLEL * len(cameras):
        found = np.linalg.solve(total, np.einsum("cij,cj->i", across, centers))
        if (found - middle) @ forward > 0:
            return np.asarray(found)
    radius = float(np.linalg.norm(centers - middle, axis=1).max()) or 1.0
    return np.asarray(middle + FAR * radius * forward)


def _agreeing(cameras: Sequence[Camera], axis: int) -> Sequence[Camera]:
    """Return the cameras; the middle one alone where their axes, rows of R, cancel."""
    mean = np.mean([c.R[axis] for c in cameras], axis=0)
    return cameras if np.linalg.norm(mean) >= CANCEL else (fixed(cameras)(0.0),)


def orbit(cameras: Sequence[Camera]) -> Path:
    """Return a closed ellipse as wide and as high as the array, around its middle, directed at the focus.

    Of cameras that stand around the scene it is the middle one's alone.
    """
    target, cameras = focus(cameras), _agreeing(cameras, 2)
    centers = np.stack([c.center for c in cameras])
    middle, up = centers.mean(0), -np.mean([c.R[1] for c in _agreeing(cameras, 1)], axis=0)
    first = look_at("orbit", middle, target, up, focal=1.0, width=1, height=1)
    right, down = first.R[0], first.R[1]
    reach = [float(np.abs((centers - middle) @ axis).max()) for axis in (right, down)]
    if max(reach) <= 1e-9 * float(np.abs(centers).max()):  # one centre, but for rounding
        reach = [ALONE * float(np.linalg.norm(target - middle))] * 2
    focal = float(np.mean([(c.fx + c.fy) / 2 for c in cameras]))
    size = cameras[0]

    def at(s: float) -> Camera:
        angle = 2 * math.pi * s
        center = middle + reach[0] * math.cos(angle) * right + reach[1] * math.sin(angle) * down
        return look_at("orbit", center, target, up, focal=focal, width=size.width, height=size.height)

    return at


def rig(cameras: Sequence[Camera]) -> Path:
    """Return a path from training camera to training camera, each time to the nearest new one, with soft stops."""
    from scipy.spatial.transform import Rotation, Slerp

    order = visiting_order(np.stack([c.center for c in cameras]))
    stops = [cameras[i] for i in order]
    turns = Rotation.from_matrix(np.stack([c.R for c in stops]))

    def at(s: float) -> Camera:
        stop = min(max(s, 0.0), 1.0) * (len(stops) - 1)
        i = min(int(stop), max(len(stops) - 2, 0))
        w = stop - i
        w = w * w * (3 - 2 * w)
        a, b = stops[i], stops[min(i + 1, len(stops) - 1)]
        R = Slerp([0.0, 1.0], turns[[i, min(i + 1, len(stops) - 1)]])(w).as_matrix()
        values = {k: (1 - w) * getattr(a, k) + w * getattr(b, k) for k in ("fx", "fy", "cx", "cy")}
        center = (1 - w) * a.center + w * b.center
        lenses = [np.array(c.distortion or [0.0] * len(NAMES)) for c in (a, b)]
        lens = make_distortion(((1 - w) * lenses[0] + w * lenses[1]).tolist())
        return replace(stops[0], id="rig", R=R, t=-R @ center, distortion=lens, **values)

    return at


def visiting_order(centers: Float64) -> list[int]:
    """Return the order of centres [C, 3]: the one farthest from the middle, then always the nearest that is left."""
    left = set(range(len(centers)))
    here = int(np.argmax(np.linalg.norm(centers - centers.mean(0), axis=1)))
    order = [here]
    while left := left - {here}:
        here = min(left, key=lambda i: (round(float(np.linalg.norm(centers[i] - centers[here])), 9), i))
        order.append(here)
    return order


def fixed(cameras: Sequence[Camera], name: str | None = None) -> Path:
    """Return a path that is one training camera throughout. Raises UserError for a name that none has."""
    known = {c.id: c for c in cameras}
    if name is None:
        middle = np.mean([c.center for c in cameras], axis=0)
        chosen = min(cameras, key=lambda c: float(np.linalg.norm(c.center - middle)))
    elif name in known:
        chosen = known[name]
    else:
        raise unknown("--camera", name, known)
    return lambda s: chosen


def resized(camera: Camera, scale: float) -> Camera:
    """Return the same view with `scale` times as many pixels each way, rounded to even numbers for video codecs.

    The rounding stretches a view by a pixel at most.
    """
    width, height = (max(2, 2 * round(scale * n / 2)) for n in (camera.width, camera.height))
    return camera.scaled(width, height)
