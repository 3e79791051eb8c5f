"""The supervision `exposure`: a frame against the mean of instants that are rendered over its exposure.

Blur is then a part of the image formation, and not of the scene: deblurring by rendering, as Deblur-NeRF (Ma et al.,
CVPR 2022) and BAD-Gaussians (Zhao et al., ECCV 2024) do for a camera that moves. There the instants differ by the
camera's pose, which is learned; here the cameras rest, and the instants differ by the scene's own motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.supervision.base import Render, Sample, Supervision, difference
from spike4dgs.method.supervision.pixel import PixelSettings


@dataclass(frozen=True)
class ExposureSettings(PixelSettings):
    """Numbers of the supervision `exposure` (prefix `supervision`)."""

    instants: int = 5  # rendered over an exposure; each costs a render a step


class Exposure(Supervision):
    """The loss of `pixel` on the mean of renders over the exposure of the images, which may be an instant."""

    label = "exposures integrated by rendering"
    defaults = ExposureSettings()

    def __init__(self, settings: ExposureSettings, scene: TrainingScene) -> None:
        super().__init__()
        self.settings, self.n_ticks = settings, scene.n_ticks

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """Return the loss of one sample, rendered at the middles of equal parts of its exposure."""
        s, length = self.settings, sample.exposure_ticks
        first = sample.tick - length // 2
        parts = [(k + 0.5) / s.instants for k in range(s.instants)] if length else []
        times = [(first + part * length) / self.n_ticks for part in parts] or [sample.t]
        image = torch.stack([render(t) for t in times]).mean(dim=0)
        return difference(image, sample.images, s.ssim_weight, s.huber_delta)
