"""The images that a fit compares with."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from spike4dgs.method.splat import Views


@dataclass(frozen=True, eq=False)
class TrainingImages:
    """Images of all training views at some times."""

    views: Views
    ticks: tuple[int, ...]  # ascending
    images: Tensor  # [T, C, H, W] linear radiance
    n_ticks: int  # length of the clip


def known(image: Tensor, rendered: Tensor) -> Tensor:
    """Return `image`, with the values of `rendered` of the same shape, without gradient, where it is no number."""
    return torch.where(image.isfinite(), image, rendered.detach())
