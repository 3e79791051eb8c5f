"""A recipe's supervision: what is compared with what. A new one is a function and a line in `SUPERVISIONS`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from spike4dgs.benchmark.scene import TrainingScene
from spike4dgs.method.settings import TrainSettings
from spike4dgs.method.splat.ssim import ssim


@dataclass(frozen=True, eq=False)
class Sample:
    """One training step: some views at one time."""

    t: float  # in [0, 1]
    tick: int
    views: tuple[int, ...]  # indices into the scene's training cameras
    pictures: Tensor  # [V, H, W] made from the spikes around the tick, 1.0 = white


Render = Callable[[float], Tensor]  # t in [0, 1] -> the sample's views at that time, [V, H, W]
Supervision = Callable[[Render, Sample], Tensor]  # -> scalar loss


def pixel(settings: TrainSettings, scene: TrainingScene) -> Supervision:
    """(1 - w) mean |I - P| + w (1 - SSIM(I, P)): the rendered against the reconstructed picture (3DGS)."""
    w = settings.ssim_weight

    def loss(render: Render, sample: Sample) -> Tensor:
        image = render(sample.t)
        absolute = (image - sample.pictures).abs().mean()
        return (1 - w) * absolute + w * (1 - ssim(image, sample.pictures)) if w else absolute

    return loss


SUPERVISIONS: dict[str, Callable[[TrainSettings, TrainingScene], Supervision]] = {"pixel": pixel}
