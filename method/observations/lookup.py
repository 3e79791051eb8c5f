"""What the views see at points of the world: which pixel, how much it changes, and its gray value at a time."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from spike4dgs.method.observations.training_images import TrainingImages
from spike4dgs.method.splat import Views


def moving(points: Tensor, footage: TrainingImages) -> Tensor:
    """How much the images change over time where points [N, 3] are seen: standard deviation, median of views, [N].

    Images are averaged over 5x5 pixels first, which removes most of what spikes leave of their own.
    """
    smooth = functional.avg_pool2d(footage.images, 5, stride=1, padding=2, count_include_pad=False)
    change = smooth.std(0, correction=0)  # [C, H, W]
    rows, inside = project(points, footage.views)
    values = torch.where(inside, change.flatten(1).gather(1, rows), math.nan)  # [C, N]
    return values.nanmedian(0).values.nan_to_num(0.0)


def look_up(points: Tensor, times: Tensor, footage: TrainingImages) -> Tensor:
    """Gray values [N] that the views see at points [N, 3] at their times [N]: median; NaN where no view looks."""
    ticks = torch.tensor(footage.ticks, dtype=torch.float32)
    index = (ticks[None] / footage.n_ticks - times[:, None]).abs().argmin(1).to(points.device)  # [N]
    rows, inside = project(points, footage.views)
    images = footage.images.flatten(2)  # [T, C, H * W]
    views = torch.arange(len(rows), device=points.device)[:, None]
    return torch.where(inside, images[index, views, rows], math.nan).nanmedian(0).values


def project(points: Tensor, views: Views) -> tuple[Tensor, Tensor]:
    """Pixels that see points [N, 3]: index into H * W [C, N], and whether the point lies in the image [C, N]."""
    p = points.to(views.w2c) @ views.w2c[:, :3, :3].mT + views.w2c[:, None, :3, 3]  # [C, N, 3]
    z = p[..., 2].clamp(min=1e-6)
    uv = (p @ views.K.mT)[..., :2] / z[..., None]
    size = uv.new_tensor([views.width, views.height])
    inside = (p[..., 2] > 0) & (uv >= 0).all(-1) & (uv < size).all(-1)
    u, v = torch.where(inside[..., None], uv, 0.0).long().unbind(-1)
    return v * views.width + u, inside
