"""Hard inputs of the rasteriser: what a fit meets now and then, and where float32 has the least room."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from spike4dgs.method.splat import Splats, Views
from spike4dgs.studies.speed.splat import random_scene

COUNT, WIDTH, HEIGHT = 200, 100, 70
Scene = tuple[Splats, Views]


def hard_scenes(seed: int) -> dict[str, Scene]:
    """Return splats in float64 and a view, by name."""
    return {name: make(*random_scene(COUNT, seed, WIDTH, HEIGHT)) for name, make in _MAKERS.items()}


def _needles(s: Splats, v: Views) -> Scene:
    return _wide(s, scales=torch.tensor([3.0, 3e-4, 3e-4]).expand(COUNT, 3)), v


def _edge_on(s: Splats, v: Views) -> Scene:
    quats = torch.tensor([1.0, 1.0, 0.0, 0.0]).expand(COUNT, 4)  # the thin axis up: lines across the image
    return _wide(s, quats=quats, scales=torch.tensor([2.0, 2.0, 1e-5]).expand(COUNT, 3)), v


def _tiny_and_huge(s: Splats, v: Views) -> Scene:
    scales = torch.full((COUNT, 3), 1e-6)
    scales[::2] = 1e3
    return _wide(s, scales=scales, opacities=s.opacities * torch.where(scales[:, 0] > 1, 0.2, 1.0)), v


def _near_plane(s: Splats, v: Views) -> Scene:
    means = s.means * torch.linspace(0.003, 0.2, COUNT)[:, None]  # some in front of the near plane
    return _wide(s, means=means), v


def _opaque(s: Splats, v: Views) -> Scene:
    return _wide(s, opacities=0.5 + 0.5 * s.opacities, scales=s.scales * 6), v


def _far_away(s: Splats, v: Views) -> Scene:
    away = torch.tensor([7e3, -5e3, 6e3], dtype=torch.float64)
    w2c = v.w2c.double().clone()
    w2c[:, :3, 3] -= w2c[:, :3, :3] @ away
    wide = _wide(s)
    return replace(wide, means=wide.means + away), replace(v, w2c=w2c)


_MAKERS: dict[str, Callable[[Splats, Views], Scene]] = {
    "needles": _needles,
    "discs, edge-on": _edge_on,
    "1e-6 and 1e3 in size": _tiny_and_huge,
    "around the near plane": _near_plane,
    "opaque stack": _opaque,
    "10 km from the origin": _far_away,
}


def _wide(s: Splats, **changes: Tensor) -> Splats:
    names = ("means", "quats", "scales", "opacities", "colors")
    return Splats(**{name: changes.get(name, getattr(s, name)).double().contiguous() for name in names})
