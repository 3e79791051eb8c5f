"""The interface of supervisions to the trainer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.settings import Settings
from spike4dgs.method.splat.ssim import huber, l1_and_ssim, met


@dataclass(frozen=True, eq=False)
class Sample:
    """One training step: some views at one time."""

    t: float  # in [0, 1]
    tick: int
    views: tuple[int, ...]  # indices into the scene's training cameras
    images: Tensor  # [V, H, W] made from the spikes around the tick, 1.0 = white
    step: int  # of the fit: seeds what is random in a loss
    exposure_ticks: int = 0  # that the images are means over, from tick - exposure_ticks // 2 on; 0: an instant


Render = Callable[[float], Tensor]  # t in [0, 1] -> the sample's views at that time, [V, H, W]


class Supervision(nn.Module):
    """A loss, with parameters of its own where it needs some. It is made from (settings, scene)."""

    label: ClassVar[str | None] = None  # in descriptions of recipes; None: the name
    calibrated: ClassVar[bool] = False  # compares with spikes of the cameras' calibrated response
    shaded: ClassVar[bool] = False  # takes the shadings that the clip tells
    defaults: ClassVar[Settings] = Settings()  # of the supervision's own settings

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """Return the scalar loss of a training step; where it renders several times, of their mean."""
        raise NotImplementedError

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """Return the parameters that are trained beside the Gaussians, and their learning rates, by group."""
        return {}

    def estimates(self) -> dict[str, Tensor]:
        """Return what the loss found out beside the scene, by name, for reports."""
        return {}


def difference(rendered: Tensor, image: Tensor, w: float, delta: float = 0.0) -> Tensor:
    """Return (1 - w) mean h(rendered - image) + w (1 - SSIM) of batches [V, H, W].

    h is |d|, or with a `delta` Huber's loss over delta.

    A pixel of `image` that is no number counts as met, and has no gradient.
    """
    return l1_and_ssim(rendered, image, w, delta) if w else huber(*met(rendered, image), delta)
