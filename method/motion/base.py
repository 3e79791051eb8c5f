"""What every motion model gives to the trainer."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.gaussians.parameters import Edit, Gaussians
from spike4dgs.method.observations.training_images import TrainingImages
from spike4dgs.method.splat import Splats, Views


@dataclass(frozen=True, eq=False)
class Extent:
    """What a motion model may know of a scene before it is fitted."""

    low: Tensor  # [3] m, corners of the box that holds the points, outliers left out
    high: Tensor  # [3]
    scale: float  # m, the scene's size as the trainer's learning rates see it
    n_ticks: int
    width: int  # px of a view


class Motion(nn.Module):
    """How Gaussians move. A model says where they are at a time; the rest has defaults that cost nothing.

    What it needs to draw is in its state dict and in `Gaussians.extra`, or follows from the extent and the settings
    that it was made from: a saved model is built again from these.
    """

    moves = True  # False: all times look the same, and only the static stage is trained
    rests_first = True  # a static stage comes before the moving one

    @property
    def pieces(self) -> int:
        """Parts of the clip, of one length, that have Gaussians of their own; odd."""
        return 1

    def splats(self, gaussians: Gaussians, t: float) -> Splats:
        """What is drawn at t in [0, 1] of the clip, or a piece; differentiable in Gaussians and own parameters."""
        raise NotImplementedError

    def image(self, image: Tensor, views: Views) -> Tensor:
        """Drawn channels [V, H, W, F] -> gray radiance [V, H, W]."""
        return image[..., 0]

    def attach(self, gaussians: Gaussians, footage: TrainingImages) -> Gaussians:
        """The first Gaussians with the parameters that the model keeps of each (`Gaussians.extra`)."""
        return gaussians

    def born(self, edit: Edit, generator: torch.Generator) -> Edit:
        """The same edit after a change of the Gaussians that densification added."""
        return edit

    def continued(self, gaussians: Gaussians, forward: bool) -> Gaussians:
        """The Gaussians of a piece as those with which the next one begins, or, not forward, the one before it."""
        raise NotImplementedError

    def guide(self, gaussians: Gaussians, footage: TrainingImages, generator: torch.Generator) -> Gaussians:
        """The Gaussians followed by new ones where images are bad; asked for `guided_rounds` times in a fit."""
        return gaussians

    def rates(self) -> dict[str, Decay]:
        """Learning rates of the parameters in `Gaussians.extra`, by name."""
        return {}

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """The model's own parameters and their learning rates, by group."""
        return {}

    def regularizer(self) -> Tensor:
        """What is added to the loss."""
        return torch.zeros(())
