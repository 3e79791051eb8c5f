"""Gaussians in light that is not the whole scene's: colours of two layers, c_0 in mean light and c_1 of a lamp.

With the lamp's factor f, whose mean is 1, a Gaussian at time t has the gray value c_0 + (f(t) - 1) c_1. Images add up
alike: both layers are rendered at once, and their images joined.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.training_views.points import project
from spike4dgs.method.training_views.training_images import TrainingImages


def factor_at(factors: Float64, t: float) -> float:
    """Return the factor at t in [0, 1] of a clip, linear between the middles of the equal parts that have `factors`."""
    return float(np.interp(t * len(factors) - 0.5, np.arange(len(factors)), factors))


def lit(gray: Tensor, channels: Tensor, factor: float) -> Tensor:
    """Return gray radiance [..., H, W] in the light of a factor, from that in mean light and both layers [..., 2]."""
    return gray + (factor - 1) * channels[..., 1]


def lamp_images(images: TrainingImages) -> tuple[Tensor, Tensor]:
    """Return f - 1 at the images' times [T], and how much of it each pixel sees [C, H, W]: the slope of its values."""
    assert images.light is not None
    at = [factor_at(images.light, tick / images.n_ticks) for tick in images.ticks]
    change = torch.tensor(at, dtype=torch.float32, device=images.images.device) - 1
    around = change - change.mean()
    slope = torch.tensordot(around, images.images, 1) / around.square().sum().clamp(min=1e-12)
    return change, slope


def in_mean_light(images: TrainingImages) -> TrainingImages:
    """Return images without what the lamp changes in them: what changes there moves. In one light they are the same."""
    if images.light is None:
        return images
    change, slope = lamp_images(images)
    values = torch.stack([image - c * slope for image, c in zip(images.images, change, strict=True)])
    return replace(images, images=values, light=None)


def with_layers(gaussians: Gaussians, images: TrainingImages) -> Gaussians:
    """Return Gaussians [N] whose colours have the lamp's layer too, as the views see it, where images have a lamp."""
    if images.light is None:
        return gaussians
    _, slope = lamp_images(images)
    pixels, inside = project(gaussians.means, images.views)
    seen = torch.where(inside, slope.flatten(1).gather(1, pixels), math.nan)  # [C, N]
    lamp = seen.nanmedian(0).values.nan_to_num(0.0)
    return replace(gaussians, colors=torch.cat([gaussians.colors, lamp[:, None].to(gaussians.colors)], 1))
