"""Gaussians to render: random ones, and hard ones, for which float32 has the least room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from spike4dgs.method.splat import Splats, Views

HEIGHT, WIDTH = 250, 400
MEAN_RADIUS_PX = {5_000: 6.2, 20_000: 4.3, 50_000: 3.4}  # scenes of more Gaussians have smaller ones
COUNT = 200  # of a hard scene
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


def hard_scenes(seed: int) -> dict[str, Scene]:
    """Return splats in float64 and a view, by name."""
    return {name: make(*random_scene(COUNT, seed, 100, 70)) for name, make in _MAKERS.items()}


def _needles(s: Splats, v: Views) -> Scene:
    return wide(s, scales=torch.tensor([3.0, 3e-4, 3e-4]).expand(COUNT, 3)), v


def _edge_on(s: Splats, v: Views) -> Scene:
    quats = torch.tensor([1.0, 1.0, 0.0, 0.0]).expand(COUNT, 4)  # the thin axis up: lines across the image
    return wide(s, quats=quats, scales=torch.tensor([2.0, 2.0, 1e-5]).expand(COUNT, 3)), v


def _tiny_and_huge(s: Splats, v: Views) -> Scene:
    scales = torch.full((COUNT, 3), 1e-6)
    scales[::2] = 1e3
    return wide(s, scales=scales, opacities=s.opacities * torch.where(scales[:, 0] > 1, 0.2, 1.0)), v


def _near_plane(s: Splats, v: Views) -> Scene:
    return wide(s, means=s.means * torch.linspace(0.003, 0.2, COUNT)[:, None]), v  # some in front of the near plane


def _opaque(s: Splats, v: Views) -> Scene:
    return wide(s, opacities=0.5 + 0.5 * s.opacities, scales=s.scales * 6), v


def _far_away(s: Splats, v: Views) -> Scene:
    away = torch.tensor([7e3, -5e3, 6e3], dtype=torch.float64)
    w2c = v.w2c.double().clone()
    w2c[:, :3, 3] -= w2c[:, :3, :3] @ away
    return replace(wide(s), means=s.means.double() + away), replace(v, w2c=w2c)


_MAKERS: dict[str, Callable[[Splats, Views], Scene]] = {
    "needles": _needles,
    "discs, edge-on": _edge_on,
    "1e-6 and 1e3 in size": _tiny_and_huge,
    "around the near plane": _near_plane,
    "opaque stack": _opaque,
    "10 km from the origin": _far_away,
}
