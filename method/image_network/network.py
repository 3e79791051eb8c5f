"""The image network: a U-Net that adds to the root of `adaptive`'s image what it learnt; at first nothing.

The root of a rate has the same shot noise in the dark and in the light, and is near to what eyes see. The metrics are
of linear radiance, in which errors in the dark count for less.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from spike4dgs.method.image_network.config import INPUTS, ImageConfig
from spike4dgs.method.image_network.inputs import CHANNELS
from spike4dgs.method.images.base import WINDOW
from spike4dgs.method.matching.network import Residual, down
from spike4dgs.method.msdi.extractor import initialize

_SIDE = 4  # px: sides are padded to multiples of it


class ImageNetwork(nn.Module):
    """See the module."""

    def __init__(self, config: ImageConfig) -> None:
        super().__init__()
        self.config = config
        a, b, c = config.widths
        self.stem = nn.Sequential(nn.Conv2d(CHANNELS + WINDOW, a, 3, padding=1), Residual(a))
        self.to_two = nn.Sequential(down(a, b), Residual(b))
        self.to_four = nn.Sequential(down(b, c), *(Residual(c) for _ in range(config.deepest)))
        self.from_four, self.two = nn.Conv2d(c, b, 1), Residual(b)
        self.from_two, self.one = nn.Conv2d(b, a, 1), Residual(a)
        self.change = nn.Conv2d(a, 1, 3, padding=1)
        initialize(self)
        nn.init.zeros_(self.change.weight)

    def forward(self, channels: Tensor, spikes: Tensor) -> Tensor:
        """Return the image's root less 1 [N, H, W] from `channels` [N, CHANNELS, H, W] and `spikes` [N, WINDOW, H, W].

        See `inputs`.
        """
        height, width = channels.shape[2:]
        full = self.stem(self._seen(channels, spikes))
        half = self.to_two(full)
        quarter = self.from_four(self.to_four(half))
        half = self.two(half + functional.interpolate(quarter, scale_factor=2.0, mode="nearest"))
        up = functional.interpolate(self.from_two(half), scale_factor=2.0, mode="nearest")
        change = self.change(self.one(full + up))[:, 0, :height, :width]
        return channels[:, 0] + change.to(channels)

    def _seen(self, channels: Tensor, spikes: Tensor) -> Tensor:
        """Return the padded inputs in the order `channels_last`, with which convolutions take two thirds of the time.

        They are written in place: copies of them took as long as a fifth of the convolutions.
        """
        n, given, height, width = channels.shape
        size = (n, given + spikes.shape[1], height + -height % _SIDE, width + -width % _SIDE)
        x = torch.empty(size, dtype=channels.dtype, device=channels.device, memory_format=torch.channels_last).zero_()
        inside = x[:, :, :height, :width]
        inside[:, :given].copy_(channels)
        sensitivity = 1 + channels[:, 6:7]
        inside[:, given:].copy_(spikes).mul_(torch.where(sensitivity > 0, 1 / sensitivity, 0.0))
        if hidden := INPUTS.get(self.config.without):
            x[:, hidden] = 0
        return x


def rate_of(root: Tensor, unit: float) -> Tensor:
    """Return spikes per tick from roots less 1 in roots of `unit`."""
    return (root + 1).clamp(min=0) ** 2 * unit


def log_mse(found: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Return the mean over images of the logarithm of the weighted mean squared error [N, H, W]: PSNR, but for a sign.

    Images whose weights are all 0 do not count.
    """
    total = weight.sum(dim=(1, 2))
    mse = ((found - truth) ** 2 * weight).sum(dim=(1, 2)) / total.clamp(min=1)
    return torch.log(mse[total > 0] + 1e-6).mean() if bool((total > 0).any()) else found.sum() * 0
