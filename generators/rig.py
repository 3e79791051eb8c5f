"""The camera array of a world: nine cameras, 3x3, named row by row from the top left; `cam_04` is in the middle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.generators.worlds import RigSpec, WorldScene


def cameras(scene: WorldScene, width: int, height: int, views: Sequence[int] = tuple(range(9))) -> tuple[Camera, ...]:
    """Return cameras `cam_00` .. `cam_08` of the array, or only `views` of it, in the given order.

    The focal length scales with `width`, so the field of view is the same at every resolution.
    Raises UserError for a view outside 0..8 or an empty image.
    """
    if width < 1 or height < 1:
        raise problem(
            "camera resolution", "at least 1x1 pixels", f"{width}x{height}", "give a positive width and height"
        )
    wrong = [v for v in views if not 0 <= v < 9]
    if wrong:
        raise problem("views", "numbers 0 to 8 of the 3x3 array", str(wrong), "leave them out")
    return tuple(grid_camera(scene.rig, v, width, height) for v in views)


def grid_camera(rig: RigSpec, view: int, width: int, height: int) -> Camera:
    """Return one of the nine cameras."""
    center, target = np.array(rig.center), np.array(rig.target)
    up = np.array([0.0, 0.0, 1.0])
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    row, column = divmod(view, 3)
    shift = (column - 1) * rig.spacing_m[0] * right + (1 - row) * rig.spacing_m[1] * np.cross(right, forward)
    focal = 0.5 * width / np.tan(np.radians(rig.fov_x_deg) / 2)
    aim = target + (1 - rig.toe_in) * shift
    return look_at(f"cam_{view:02d}", center + shift, aim, up, focal=focal, width=width, height=height)
