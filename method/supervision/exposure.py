"""The supervision `exposure`: images that are means over time against the model's means over the same time."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from spike4dgs.method.supervision.base import Render, Sample, difference
from spike4dgs.method.supervision.pixel import Pixel


class Exposure(Pixel):
    """`pixel`, with a mean over each pixel's span [a, b] in the place of an instant.

    The light is rendered at the two points +- half / sqrt(3) of Gauss and Legendre, half that of the spans, and taken
    as linear between and beyond them: w_1 I_1 + w_2 I_2 with w_2 = 1/2 + (a + b) / 2 / (2 half / sqrt(3)), within
    [0, 1], and w_1 = 1 - w_2. Over [-half, half] that is exact for light that is cubic in time. Images of instants are
    compared as `pixel` does.
    """

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """Return the loss of one sample."""
        if sample.spans is None:
            return super().forward(render, sample)
        node = sample.spans.half / math.sqrt(3)  # ticks
        before, after = (render(sample.t + at / sample.spans.n_ticks) for at in (-node, node))
        middle = sample.spans.ends.to(before).mean(1)  # [V, H, W] ticks
        later = (0.5 + middle / (2 * node)).clamp(0, 1)
        return difference(torch.lerp(before, after, later), sample.images, self.ssim_weight)
