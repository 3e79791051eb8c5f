"""A recipe's supervision: what is compared with what. A new one is a class and a line in `SUPERVISIONS`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.supervision.base import Render, Sample, Supervision
from spike4dgs.method.supervision.fixed_pattern import FixedPattern
from spike4dgs.method.supervision.pixel import Pixel, PixelSettings
from spike4dgs.method.supervision.spike import SpikeRate, SpikeSettings
from spike4dgs.method.supervision.spss import SpikeVariation, SpikeVariationSettings


class Sum(Supervision):
    """The plain sum of losses on the same rendered images, those of the sample's own time."""

    def __init__(self, *parts: Supervision) -> None:
        super().__init__()
        self.parts = nn.ModuleList(parts)

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """Return the loss of one rendered sample; it is rendered once."""
        image = render(sample.t)
        return torch.stack([part(lambda t: image, sample) for part in self.parts]).sum()

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """Return the parameters of all parts."""
        return {name: group for part in self.parts for name, group in part.groups().items()}  # type: ignore[operator]


@dataclass(frozen=True)
class PixelAndSpikeSettings(SpikeSettings, PixelSettings):
    """The settings of both parts."""


class PixelAndSpike(Sum):
    """`pixel` + `spike`: the combination in Table 4 of the Spike4DGS paper."""

    label = "pixel loss and SpikeNeRF's"
    calibrated = True
    defaults = PixelAndSpikeSettings()

    def __init__(self, settings: PixelAndSpikeSettings, scene: TrainingScene) -> None:
        super().__init__(Pixel(settings, scene), SpikeRate(settings, scene))


@dataclass(frozen=True)
class SynergySettings(SpikeVariationSettings, PixelSettings):
    """The settings of both parts."""


class Synergy(Sum):
    """Spike-pixel synergy supervision of Spike4DGS: pixel loss + spike variation loss (eq. 18)."""

    label = "SPSS"
    calibrated = True
    defaults = SynergySettings()

    def __init__(self, settings: SynergySettings, scene: TrainingScene) -> None:
        super().__init__(Pixel(settings, scene), SpikeVariation(settings, scene))


SUPERVISIONS: dict[str, type[Supervision]] = {
    "pixel": Pixel,
    "fixed-pattern": FixedPattern,
    "spike": SpikeRate,
    "pixel+spike": PixelAndSpike,
    "spss": Synergy,
}
