"""Values that the views see at points of the world: how much they vary over the clip, and the gray value at a time."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from spike4dgs.method.training_views.changes import POINTS, variation
from spike4dgs.method.training_views.projection import project
from spike4dgs.method.training_views.training_images import TrainingImages


def variation_at(points: Tensor, images: TrainingImages) -> Tensor:
    """Return the standard deviation over time where points [N, 3] are seen, [N]: median of the views, 0 if none."""
    change = variation(images.images, POINTS)  # [C, H, W]
    pixels, inside = project(points, images.views)
    values = torch.where(inside, change.flatten(1).gather(1, pixels), math.nan)  # [C, N]
    return values.nanmedian(0).values.nan_to_num(0.0)


def look_up(points: Tensor, times: Tensor, images: TrainingImages) -> Tensor:
    """Return the gray values [N] at points [N, 3] at their times [N]: median of the views, NaN if no view sees it."""
    ticks = torch.tensor(images.ticks, dtype=torch.float32)
    index = (ticks[None] / images.n_ticks - times[:, None]).abs().argmin(1).to(points.device)  # [N]
    pixels, inside = project(points, images.views)
    values = images.images.flatten(2)  # [T, C, H * W]
    views = torch.arange(len(pixels), device=points.device)[:, None]
    return torch.where(inside, values[index, views, pixels], math.nan).nanmedian(0).values
