"""Points of the world in the training views: the pixels that see them, how their values vary, the value at a time."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from spike4dgs.method.splat import Views
from spike4dgs.method.splat.lens import bent
from spike4dgs.method.training_views.changes import POINTS, variation
from spike4dgs.method.training_views.training_images import TrainingImages


def project(points: Tensor, views: Views) -> tuple[Tensor, Tensor]:
    """Return the pixels that see points [N, 3]: index into H * W [C, N], and whether the point is in the image [C, N].

    The index of a point outside the image is 0. Computes in the wider dtype of points and views.
    """
    dtype = torch.promote_types(points.dtype, views.w2c.dtype)
    w2c, K = views.w2c.to(dtype), views.K.to(dtype)
    p = points.to(w2c) @ w2c[:, :3, :3].mT + w2c[:, None, :3, 3]  # [C, N, 3]
    in_front = p[..., 2] > 0
    if views.lenses is not None:
        xy, shown = bent(p[..., :2] / torch.where(in_front, p[..., 2], 1.0)[..., None], views.lenses[:, None].to(dtype))
        p, in_front = torch.cat([xy, torch.ones_like(xy[..., :1])], -1), in_front & shown
    uv = (p @ K.mT)[..., :2] / torch.where(in_front, p[..., 2], 1.0)[..., None]
    size = uv.new_tensor([views.width, views.height])
    inside = in_front & (uv >= 0).all(-1) & (uv < size).all(-1)
    u, v = torch.where(inside[..., None], uv, 0.0).long().unbind(-1)
    return v * views.width + u, inside


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
