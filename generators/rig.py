"""The camera array of a world: nine cameras, 3x3, named row by row from the top left; `cam_04` is in the middle.

The array may move during the clip, all cameras together: see `ArrayPath`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.generators.physics import Physics
from spike4dgs.generators.worlds import RigSpec, WorldScene

_BEND_RAD_S = 5.0  # turn of the direction of travel: at 2 m/s it takes the acceleration of gravity


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


@dataclass(frozen=True, eq=False)
class ArrayPath:
    """The motion of a rigid array: its middle camera goes along an arc at a steady speed, and all turn about it.

    The frame of the array is that of the world at t = 0. Cameras keep their poses in it.

    Attributes:
        center: [3] position of the middle camera at t = 0, world metres.
        along, toward: [3] orthogonal unit vectors: the direction of travel at t = 0, and that to which it bends.
        speed_m_s: speed along the arc.
        turn: [3] angular velocity, rad/s.
    """

    center: Float64
    along: Float64
    toward: Float64
    speed_m_s: float
    turn: Float64

    def to_world(self, t_s: float) -> Float64:
        """Return the transform [4, 4] from the frame of the array to the world at a time."""
        angle, radius = _BEND_RAD_S * t_s, self.speed_m_s / _BEND_RAD_S
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(self.turn * t_s).as_matrix()
        shift = radius * (np.sin(angle) * self.along + (1 - np.cos(angle)) * self.toward)
        pose[:3, 3] = self.center + shift - pose[:3, :3] @ self.center
        return pose

    def posed(self, cameras: Sequence[Camera], t_s: float) -> tuple[Camera, ...]:
        """Return cameras of the array where they are in the world at a time."""
        pose = self.to_world(t_s)
        turned = [(c, c.R @ pose[:3, :3].T) for c in cameras]
        return tuple(replace(c, R=R, t=c.t - R @ pose[:3, 3]) for c, R in turned)

    def described(self, ticks: Sequence[int], rate_hz: float) -> dict[str, Any]:
        """Return the path at some ticks, for `truth/array_path.json` of a scene."""
        return {"ticks": list(ticks), "array_to_world": [self.to_world(t / rate_hz).tolist() for t in ticks]}


def array_path(rig: RigSpec, physics: Physics, entropy: Sequence[int]) -> ArrayPath | None:
    """Return the path of an array; None where it stands still. `entropy`: of the directions.

    It starts in a direction of the plane of the cameras and bends away from it, toward what they look at. The axis of
    its turn is any.
    """
    if not physics.moves_array:
        return None
    rng = np.random.default_rng([*entropy, *b"array path"])
    right, down, forward = grid_camera(rig, 4, 2, 2).R
    angle = rng.uniform(0, 2 * np.pi)
    axis = rng.normal(size=3)
    return ArrayPath(
        np.array(rig.center),
        np.cos(angle) * right + np.sin(angle) * down,
        forward,
        physics.array_motion,
        axis * (np.radians(physics.array_rotation) / np.linalg.norm(axis)),
    )
