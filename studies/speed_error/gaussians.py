"""Gaussians to render: random ones, and some far from the origin, where float32 has the least room."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from spike4dgs.method.splat import Splats, Views

HEIGHT, WIDTH = 250, 400
MEAN_RADIUS_PX = {5_000: 6.2, 20_000: 4.3, 50_000: 3.4}  # scenes of more Gaussians have smaller ones
Scene = tuple[Splats, Views]


def random_scene(n: int, seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> Scene:
    """Return N Gaussians in front of a camera, most in view; float32, one channel.

    Radii are those of `MEAN_RADIUS_PX` in an image of 400 px, and grow with the width.
    """
    g = torch.Generator().manual_seed(seed)
    z = 2 + 4 * torch.rand(n, generator=g)
    at = [(1.06 * torch.rand(n, generator=g) - 0.53) * size / width * z for size in (width, height)]
    size = MEAN_RADIUS_PX.get(n, 4.3) / 2.6 / WIDTH * torch.exp(0.45 * torch.randn(n, generator=g)) * z
    scales = size[:, None] * torch.exp(0.45 * torch.randn(n, 3, generator=g))
    opacities = torch.sigmoid(1.5 * torch.randn(n, generator=g))
    quats, colors = torch.randn(n, 4, generator=g), torch.rand(n, 1, generator=g)
    K = torch.tensor([[[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]]])
    splats = Splats(torch.stack([*at, z], -1), quats, scales, opacities, colors)
    return splats, Views(torch.eye(4)[None], K, width, height)


def wide(s: Splats, **changes: Tensor) -> Splats:
    """Return splats in float64, with some parameters replaced."""
    names = ("means", "quats", "scales", "opacities", "colors")
    return Splats(**{name: changes.get(name, getattr(s, name)).double().contiguous() for name in names})


def far_away(seed: int) -> Scene:
    """Return 200 random Gaussians and their view 10 km from the world's origin, in float64."""
    splats, views = random_scene(200, seed, 100, 70)
    away = torch.tensor([7e3, -5e3, 6e3], dtype=torch.float64)
    w2c = views.w2c.double().clone()
    w2c[:, :3, 3] -= w2c[:, :3, :3] @ away
    return replace(wide(splats), means=splats.means.double() + away), replace(views, w2c=w2c)
