"""A recipe's supervision: what is compared with what. A new one is a class and a line in `SUPERVISIONS`."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.settings import TrainSettings
from spike4dgs.method.supervision.base import Render, Sample, Supervision, difference
from spike4dgs.method.supervision.spike import SpikeRate
from spike4dgs.method.supervision.spike_render import SpikeRender
from spike4dgs.method.supervision.spss import SpikeVariation


class Pixel(Supervision):
    """(1 - w) mean |I - P| + w (1 - SSIM(I, P)): the rendered against the reconstructed image (3DGS).

    w = `ssim_weight`; with 0 it is the pixel loss of 4DGS and of Spike4DGS (eq. 14).
    """

    def __init__(self, settings: TrainSettings, scene: TrainingScene) -> None:
        super().__init__()
        self.ssim_weight = settings.ssim_weight

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """The loss of one rendered sample."""
        return difference(render(sample.t), sample.images, self.ssim_weight)


class Sum(Supervision):
    """The plain sum of losses that look at the same rendered images, those of the sample's own time."""

    def __init__(self, *parts: Supervision) -> None:
        super().__init__()
        self.parts = nn.ModuleList(parts)

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """The loss of one rendered sample; it is rendered once."""
        image = render(sample.t)
        return torch.stack([part(lambda t: image, sample) for part in self.parts]).sum()

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """The parameters of all parts."""
        return {name: group for part in self.parts for name, group in part.groups().items()}  # type: ignore[operator]


def pixel_and_spike(settings: TrainSettings, scene: TrainingScene) -> Sum:
    """`pixel` + `spike`: the combination in Table 4 of the Spike4DGS paper."""
    return Sum(Pixel(settings, scene), SpikeRate(settings, scene))


def synergy(settings: TrainSettings, scene: TrainingScene) -> Sum:
    """Spike-pixel synergy supervision of Spike4DGS: pixel loss + spike variation loss (eq. 18)."""
    return Sum(Pixel(settings, scene), SpikeVariation(settings, scene))


SUPERVISIONS: dict[str, Callable[[TrainSettings, TrainingScene], Supervision]] = {
    "pixel": Pixel,
    "spike": SpikeRate,
    "spike-render": SpikeRender,
    "pixel+spike": pixel_and_spike,
    "spss": synergy,
}
