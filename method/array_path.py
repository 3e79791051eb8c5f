"""The motion of a rigid array through a world that stands still, as polynomials in time.

The frame of a fit, the world's, is that of the array near the middle of the clip, where cameras have the poses that are
given. At a time t in [0, 1] of the clip a point x of the world is, in the frame of the array,

    R(t) (x - p) + p + s(t),    (r(t), s(t)) = c1 u + c2 u^2 + c3 u^3,    u = t - t0,

with R the rotation of the vector r, and a pivot p, the middle of the cameras.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.splat import Splats

DEGREE = 3


@dataclass(frozen=True, eq=False)
class ArrayPath:
    """See the module.

    Attributes:
        coefficients: [DEGREE, 6] float64, of the rotation vector, rad, and the shift, m.
        pivot: [3] m.
        time: t0, at which the frame of the world is that of the array.
    """

    coefficients: Float64
    pivot: Float64
    time: float

    def powers(self, t: float) -> Float64:
        """Return u, u^2 ... [DEGREE] at a time."""
        return np.asarray((t - self.time) ** np.arange(1, DEGREE + 1))

    def to_array(self, t: float) -> Float64:
        """Return the transform [4, 4] from the world to the frame of the array at t in [0, 1] of the clip."""
        turn, shift = np.split(self.powers(t) @ self.coefficients, 2)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
        pose[:3, 3] = self.pivot + shift - pose[:3, :3] @ self.pivot
        return pose

    def posed(self, cameras: Sequence[Camera], t: float) -> tuple[Camera, ...]:
        """Return cameras of the array where they are in the world at t."""
        pose = self.to_array(t)
        return tuple(replace(c, R=c.R @ pose[:3, :3], t=c.R @ pose[:3, 3] + c.t) for c in cameras)

    def carried(self, splats: Splats, t: float) -> Splats:
        """Return splats of the world as they are in the frame of the array at t; differentiable."""
        pose = self.to_array(t)
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])  # of products, wxyz
        turn, shift = (torch.as_tensor(a).to(splats.means) for a in (pose[:3, :3], pose[:3, 3]))
        return replace(splats, means=splats.means @ turn.T + shift, quats=splats.quats @ left.to(splats.quats).T)

    def tensors(self) -> dict[str, Tensor]:
        """Return the numbers for a model's file."""
        numbers = {"coefficients": self.coefficients, "pivot": self.pivot, "time": self.time}
        return {name: torch.as_tensor(value, dtype=torch.float64) for name, value in numbers.items()}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Tensor]) -> ArrayPath:
        """Return the path of `tensors`. Raises KeyError or ValueError for anything else."""
        values = [tensors[name].double().cpu().numpy() for name in ("coefficients", "pivot", "time")]
        shapes = [(DEGREE, 6), (3,), ()]
        if [v.shape for v in values] != shapes or not all(np.isfinite(v).all() for v in values):
            raise ValueError(f"finite numbers of the array's path, of shapes {shapes}")
        return cls(values[0], values[1], float(values[2]))
