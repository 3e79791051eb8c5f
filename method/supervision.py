"""A recipe's supervision: what is compared with what. A new one is a class and a line in `SUPERVISIONS`."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from spike4dgs.benchmark.scene import TrainingScene
from spike4dgs.method.settings import TrainSettings
from spike4dgs.method.spike_render import SpikeRender
from spike4dgs.method.supervision_model import Render, Sample, Supervision, difference


class Pixel(Supervision):
    """(1 - w) mean |I - P| + w (1 - SSIM(I, P)): the rendered against the reconstructed picture (3DGS)."""

    def __init__(self, settings: TrainSettings, scene: TrainingScene) -> None:
        super().__init__()
        self.ssim_weight = settings.ssim_weight

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """The loss of one rendered sample."""
        return difference(render(sample.t), sample.pictures, self.ssim_weight)


SUPERVISIONS: dict[str, Callable[[TrainSettings, TrainingScene], Supervision]] = {
    "pixel": Pixel,
    "spike-render": SpikeRender,
}
