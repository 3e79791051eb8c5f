"""Poses of the training cameras, fitted together with the scene: nine cameras and all times, six numbers a camera.

A camera's pose is exp(xi) w2c with xi = (rotation, translation / depth). The first camera keeps its pose: it holds
the frame, in which the held-out cameras are given too. It cannot hold the scale, which starts right and which pixels
do not pull at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.splat import Views


def rigid_motion(xi: Tensor) -> Tensor:
    """Return the exponential [..., 4, 4] of xi [..., 6] (rotation vector, translation part); smooth at zero too."""
    x, y, z, a, b, c = xi.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, a, z, zero, -x, b, -y, x, zero, c, zero, zero, zero, zero]
    motion: Tensor = torch.linalg.matrix_exp(torch.stack(rows, dim=-1).unflatten(-1, (4, 4)))
    return motion


class Poses(nn.Module):
    """Corrections of the poses of `views`; `depth_m` is the scene's distance."""

    def __init__(self, views: Views, depth_m: float) -> None:
        super().__init__()
        self._start, self._depth_m = views, depth_m
        self.xi = nn.Parameter(torch.zeros(len(views) - 1, 6, dtype=views.w2c.dtype, device=views.w2c.device))

    def views(self, chosen: Sequence[int]) -> Views:
        """Return some of the views at their present poses, differentiable in `xi`."""
        start, index = self._start, list(chosen)
        units = torch.tensor([1.0] * 3 + [self._depth_m] * 3, dtype=self.xi.dtype, device=self.xi.device)
        moved = nn.functional.pad(self.xi * units, (0, 0, 1, 0))[index]
        return Views(rigid_motion(moved) @ start.w2c[index], start.K[index], start.width, start.height)

    @torch.no_grad()
    def cameras(self, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
        """Return `cameras`, those that the views were made of, at their present poses."""
        found = self.views(range(len(cameras))).w2c.double().cpu().numpy()
        return tuple(replace(c, R=w2c[:3, :3], t=w2c[:3, 3]) for c, w2c in zip(cameras, found, strict=True))
