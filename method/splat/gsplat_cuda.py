"""Back end "cuda": gsplat 1.5.3, imported when it is first used.

gsplat computes in float32. So that a world far from its origin stays sharp, float64 inputs are shifted to the first
camera in float64 before they are rounded.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.gpu import missing_rasterizer
from spike4dgs.method.splat.types import RenderOutput, Splats, Views, require_finite


@cache
def _rasterization() -> Any:
    if missing := missing_rasterizer():
        fix = f"{missing.fix}, or move the tensors to the CPU"
        raise problem("back end cuda", missing.expected, missing.found, fix)
    from gsplat import rasterization  # type: ignore[import-not-found, unused-ignore]

    return rasterization


def recentre(means: Tensor, w2c: Tensor) -> tuple[Tensor, Tensor]:
    """Shift the world so that the first camera is its origin: means [N, 3], w2c [C, 4, 4] -> the same, float32.

    The subtraction happens in the inputs' precision and is differentiable in both.
    """
    wide = torch.promote_types(means.dtype, w2c.dtype)
    origin = -(w2c[0, :3, :3].detach().to(wide).T @ w2c[0, :3, 3].detach().to(wide))  # [3]
    translation = w2c[:, :3, 3].to(wide) + w2c[:, :3, :3].to(wide) @ origin  # [C, 3]
    moved = torch.cat([w2c[:, :3, :3].to(wide), translation[..., None]], -1)
    bottom = w2c[:, 3:].to(wide)
    return (means.to(wide) - origin).float(), torch.cat([moved, bottom], 1).float()


def render_cuda(
    splats: Splats, views: Views, *, depth: bool, antialiased: bool, near: float, eps2d: float
) -> RenderOutput:
    """Render with the back end "cuda": see `render` for the arguments."""
    rasterization = _rasterization()
    if not splats.means.is_cuda:
        raise problem("back end cuda", "tensors on a CUDA device", str(splats.means.device), "move them with .cuda()")
    require_finite(splats)
    device = splats.means.device
    means, w2c = recentre(splats.means, views.w2c.to(device))
    exists = splats.quats.square().sum(-1, keepdim=True) > 0  # gsplat would make NaN of a zero quaternion
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], device=device)
    layers, alpha, info = rasterization(
        means,
        torch.where(exists, splats.quats.float(), identity),
        splats.scales.float(),
        torch.where(exists[:, 0], splats.opacities.float(), 0.0),
        splats.colors.float(),
        w2c,
        views.K.to(device).float(),
        views.width,
        views.height,
        near_plane=near,
        eps2d=eps2d,
        packed=False,
        render_mode="RGB+D" if depth else "RGB",
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    means2d = info["means2d"]
    if means2d.requires_grad:
        means2d.retain_grad()
    image, far = (layers[..., :-1], layers[..., -1]) if depth else (layers, None)
    return RenderOutput(image, alpha[..., 0], far, info["radii"].amax(-1).float(), means2d)
