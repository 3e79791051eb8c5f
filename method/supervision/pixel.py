"""The supervision `pixel`: the rendered against the reconstructed image."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.settings import Settings
from spike4dgs.method.supervision.base import Render, Sample, Supervision, difference


@dataclass(frozen=True)
class PixelSettings(Settings):
    """Numbers of the supervision `pixel` (prefix `supervision`)."""

    ssim_weight: float = 0.2  # 3DGS's lambda; 4DGS publishes 0, which blurs
    huber_delta: float = 0.0  # white, below which differences count squared: their mean counts, not their median


class Pixel(Supervision):
    """(1 - w) mean |I - P| + w (1 - SSIM(I, P)), the loss of 3DGS.

    w = `ssim_weight`; with 0 it is the pixel loss of 4DGS and of Spike4DGS (eq. 14). A `huber_delta` makes |d| Huber's.
    """

    label = ""
    defaults = PixelSettings()

    def __init__(self, settings: PixelSettings, scene: TrainingScene) -> None:
        super().__init__()
        self.settings = settings

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """Return the loss of one rendered sample."""
        return difference(render(sample.t), sample.images, self.settings.ssim_weight, self.settings.huber_delta)
