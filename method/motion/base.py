"""The interface of motion models to the trainer."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.gaussians.parameters import Edit, Gaussians
from spike4dgs.method.settings import Settings
from spike4dgs.method.splat import Splats, Views
from spike4dgs.method.splat.types import CUSTOMARY, PixelFilter
from spike4dgs.method.training_views.training_images import TrainingImages

PART_TICKS = 400  # 20 ms at 20 kHz, for which step counts are
PART_IMAGES = 20  # at least about as many times of a view in each part of a clip


@dataclass(frozen=True, eq=False)
class Extent:
    """All that a motion model may know of a scene before it is fitted."""

    low: Tensor  # [3] m, corners of the box that holds the points, outliers left out
    high: Tensor  # [3]
    scale: float  # m, the scene's size as the trainer's learning rates see it
    n_ticks: int
    width: int  # px of a view
    images: float = math.inf  # of a view over the clip, about; a saved model has no use for it
    pace: float = 1.0  # times that motion is faster than about a pixel from image to image; nor for this

    @property
    def parts(self) -> float:
        """The clip's length in parts of 20 ms, at least 1. Steps follow it, and pieces where a motion has some.

        Parts are longer where images are too far apart for that, and as much shorter where motion is faster.
        """
        return max(1.0, min(self.n_ticks * self.pace / PART_TICKS, self.images / PART_IMAGES))


class Motion(nn.Module):
    """The motion of Gaussians. A model gives their splats at a time; the rest has defaults that cost nothing.

    All that it needs to render is in its state dict and in `Gaussians.extra`, or follows from the extent and the
    settings that it was made from: a saved model is built again from these.
    """

    label: ClassVar[str | None] = None  # in descriptions of recipes; None: the name
    defaults: ClassVar[Settings] = Settings()  # of the model's own settings
    published: ClassVar[Mapping[str, Any]] = {}  # step counts of the publication, see `settings.in_budget`
    moves: ClassVar[bool] = True  # False: all times are the same, and only the static stage is trained
    rests_first: ClassVar[bool] = True  # a static stage comes before the moving one
    pixel_filter: PixelFilter = CUSTOMARY  # of the fit's renders; the trainer sets it

    @property
    def pieces(self) -> int:
        """Parts of the clip, of one length, that have Gaussians of their own; odd."""
        return 1

    @property
    def coherence(self) -> float:
        """Weight of `coherence.Coherence`, for a motion whose Gaussians have `coefficients` of cubic paths."""
        return 0.0

    @property
    def guided_rounds(self) -> int:
        """Number of times in a fit that the trainer asks for `guided_samples`."""
        return 0

    def splats(self, gaussians: Gaussians, t: float) -> Splats:
        """Return the splats at t in [0, 1] of the clip, or a piece; differentiable in Gaussians and parameters."""
        raise NotImplementedError

    def image(self, image: Tensor, views: Views) -> Tensor:
        """Return gray radiance [V, H, W] of rendered channels [V, H, W, F]."""
        return image[..., 0]

    def initialize(self, gaussians: Gaussians, images: TrainingImages) -> Gaussians:
        """Return the first Gaussians with the parameters that the model keeps of each (`Gaussians.extra`)."""
        return gaussians

    def set_off(self, gaussians: Gaussians, images: TrainingImages) -> Gaussians:
        """Return the Gaussians that move as they leave the static stage, before a background that is frozen."""
        return gaussians

    def after_densification(self, edit: Edit, generator: torch.Generator) -> Edit:
        """Return the edit after a change of the Gaussians that densification added."""
        return edit

    def next_piece(self, gaussians: Gaussians, forward: bool) -> Gaussians:
        """Return the Gaussians with which the next piece begins, or, not forward, the one before."""
        raise NotImplementedError

    def guided_samples(self, gaussians: Gaussians, images: TrainingImages, generator: torch.Generator) -> Gaussians:
        """Return the Gaussians followed by new ones where renders are bad."""
        return gaussians

    def learning_rates(self) -> dict[str, Decay]:
        """Return the learning rates of the parameters in `Gaussians.extra`, by name."""
        return {}

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """Return the model's own parameters and their learning rates, by group."""
        return {}

    def regularizer(self) -> Tensor:
        """Return the term that is added to the loss."""
        return torch.zeros(())
