"""What every supervision gives to the trainer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.splat.ssim import ssim


@dataclass(frozen=True, eq=False)
class Sample:
    """One training step: some views at one time."""

    t: float  # in [0, 1]
    tick: int
    views: tuple[int, ...]  # indices into the scene's training cameras
    images: Tensor  # [V, H, W] made from the spikes around the tick, 1.0 = white
    step: int  # of the fit: seeds what is random in a loss


Render = Callable[[float], Tensor]  # t in [0, 1] -> the sample's views at that time, [V, H, W]


class Supervision(nn.Module):
    """A loss, with parameters of its own where it needs some."""

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """The scalar loss of a training step."""
        raise NotImplementedError

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """The parameters that are trained beside the Gaussians, and their learning rates, by group."""
        return {}


def known(picture: Tensor, image: Tensor) -> Tensor:
    """The image, and the rendered `image` of the same shape, without its gradient, where the image is no number."""
    return torch.where(picture.isfinite(), picture, image.detach())


def difference(image: Tensor, picture: Tensor, w: float) -> Tensor:
    """(1 - w) mean |image - image| + w (1 - SSIM) of batches [V, H, W].

    A pixel of `image` that is no number counts as met.
    """
    picture = known(picture, image)
    absolute = (image - picture).abs().mean()
    return (1 - w) * absolute + w * (1 - ssim(image, picture)) if w else absolute
