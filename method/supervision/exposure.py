"""The supervision `exposure`: images that are means over time against the model's means over the same time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.supervision.base import Render, Sample, Supervision, difference
from spike4dgs.method.supervision.pixel import PixelSettings


@dataclass(frozen=True)
class ExposureSettings(PixelSettings):
    """The weight of SSIM, and where the model is rendered (prefix `supervision`)."""

    half: float = 10.0  # ticks; of the spans, about


class Exposure(Supervision):
    """`pixel`, with a mean over each pixel's span [a, b] in the place of an instant.

    The light is rendered at the two points +- half / sqrt(3) of Gauss and Legendre, and taken as linear between and
    beyond them: w_1 I_1 + w_2 I_2 with w_2 = 1/2 + (a + b) / 2 / (2 half / sqrt(3)), w_1 = 1 - w_2. Over [-half, half]
    that is exact for light that is cubic in time.
    """

    defaults = ExposureSettings()

    def __init__(self, settings: ExposureSettings, scene: TrainingScene) -> None:
        super().__init__()
        self.settings = settings

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """Return the loss of one sample."""
        s = self.settings
        if sample.spans is None:
            return difference(render(sample.t), sample.images, s.ssim_weight)
        node = s.half / math.sqrt(3)
        before, after = (render(sample.t + sign * node * sample.tick_t) for sign in (-1, 1))
        middle = sample.spans.to(before).mean(1)  # [V, H, W]
        later = (0.5 + middle / (2 * node)).clamp(0, 1)
        return difference(torch.lerp(before, after, later), sample.images, s.ssim_weight)
