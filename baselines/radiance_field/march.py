"""Ray marching: sampling of rays, and sums of their samples (Max 1995; Mildenhall et al. 2020).

A sample lies on its ray at a depth z along the camera's axis between two planes, which hold the scene. The far
plane is opaque: whatever light is left there sees the field's value on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from spike4dgs.benchmark.scene.cameras import Camera


@dataclass(frozen=True, eq=False)
class Rays:
    """R rays o + z d. `directions` have 1 along the camera's axis, so that z is the depth."""

    origins: Tensor  # [R, 3] m
    directions: Tensor  # [R, 3]

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, index: slice | Tensor) -> Rays:
        return Rays(self.origins[index], self.directions[index])

    def at(self, z: Tensor) -> Tensor:
        """Return points [R, n, 3] m at depths z [R, n]."""
        return self.origins[:, None] + z[..., None] * self.directions[:, None]

    @property
    def lengths(self) -> Tensor:
        """Metres per metre of depth [R]."""
        return self.directions.norm(dim=-1)


def camera_rays(camera: Camera, device: str = "cpu") -> Rays:
    """Return the rays of all pixels of a camera, row by row, through the pixels' centres."""
    v, u = np.mgrid[: camera.height, : camera.width].reshape(2, -1) + 0.5
    xy = camera.normalized(np.stack([u, v], -1))
    towards = np.stack([xy[:, 0], xy[:, 1], np.ones_like(u)], -1) @ camera.R
    directions = torch.as_tensor(towards, dtype=torch.float32, device=device)
    origin = torch.as_tensor(camera.center, dtype=torch.float32, device=device)
    return Rays(origin.expand(len(directions), 3), directions)


def spread(rays: int, count: int, generator: torch.Generator | None) -> Tensor:
    """Return fractions [rays, count] in [0, 1]: one in each of `count` bins, random, or its middle by default."""
    within = torch.rand(rays, count, generator=generator) if generator else torch.full((rays, count), 0.5)
    return (torch.arange(count) + within) / count


def resample(fractions: Tensor, weights: Tensor, u: Tensor) -> Tensor:
    """Return fractions [R, m] distributed as the weights along rays: their inverse piecewise linear CDF at u [R, m].

    `fractions` [R, n] ascend, `weights` [R, n] are their samples' shares of the image. A sample's weight is spread
    evenly over the stretch between the middles of its neighbours, so that the ends' weights are not used (as
    published). A little is added to each weight, so that a ray that meets nothing is sampled everywhere.
    """
    middles = 0.5 * (fractions[:, 1:] + fractions[:, :-1])  # [R, n - 1]
    share = weights[:, 1:-1] + 1e-5
    cdf = torch.cumsum(share / share.sum(-1, keepdim=True), -1)
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf], -1)  # [R, n - 1]
    upper = torch.searchsorted(cdf, u.contiguous(), right=True).clamp(1, cdf.shape[1] - 1)
    low, high = cdf.gather(1, upper - 1), cdf.gather(1, upper)
    a, b = middles.gather(1, upper - 1), middles.gather(1, upper)
    return a + (b - a) * ((u - low) / (high - low).clamp(min=1e-8)).clamp(0, 1)


def weigh(density: Tensor, z: Tensor, lengths: Tensor) -> Tensor:
    """Return each sample's share [R, n] in its ray's image; the last one takes the rest, so that they sum to 1.

    w_i = T_i (1 - exp(-density_i delta_i)), T_i = exp(-sum_{j<i} density_j delta_j), where delta_i is the distance to
    the next sample: `density` [R, n] in 1/m, depths z [R, n] ascending, `lengths` [R] metres per metre of depth.
    """
    thickness = density[:, :-1] * z.diff(dim=-1) * lengths[:, None]  # [R, n - 1]
    reached = torch.cat([torch.zeros_like(thickness[:, :1]), thickness.cumsum(-1)], -1)
    transmitted = torch.exp(-reached)  # [R, n]
    return torch.cat([transmitted[:, :-1] - transmitted[:, 1:], transmitted[:, -1:]], -1)
