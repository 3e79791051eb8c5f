"""The motion part of a recipe: how Gaussians move. A new model is one file and one line in `MOTIONS`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from spike4dgs.method.gaussians import Gaussians
from spike4dgs.method.hexplane import HexPlaneMotion, HexPlaneShape, plane_tv, time_smoothness, time_sparsity
from spike4dgs.method.optimizer import Decay
from spike4dgs.method.settings import TrainSettings


@dataclass(frozen=True, eq=False)
class Extent:
    """What a motion model may know of a scene before it is fitted."""

    low: Tensor  # [3] m, corners of the box that holds the points, outliers left out
    high: Tensor  # [3]
    scale: float  # m, the scene's size as the trainer's learning rates see it
    n_ticks: int
    width: int  # px of a view


class Motion(Protocol):
    """Gaussians at rest to Gaussians at a time, with parameters of its own (an `nn.Module` for its state)."""

    moves: bool  # False: no deforming stage is trained

    def deform(self, gaussians: Gaussians, t: float) -> Gaussians:
        """The Gaussians at t in [0, 1], differentiable in both."""
        ...

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """The model's own parameters and their learning rates, by group."""
        ...

    def regularizer(self) -> Tensor:
        """What is added to the loss."""
        ...

    def state_dict(self) -> dict[str, Tensor]:
        """Parameters and buffers for a checkpoint."""
        ...

    def load_state_dict(self, state: dict[str, Tensor]) -> object:
        """Restore them."""
        ...


class Static(nn.Module):
    """Nothing moves."""

    moves = False

    def deform(self, gaussians: Gaussians, t: float) -> Gaussians:
        """The same Gaussians."""
        return gaussians

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """None."""
        return {}

    def regularizer(self) -> Tensor:
        """Zero."""
        return torch.zeros(())


class HexPlane4DGS(HexPlaneMotion):
    """`hexplane.HexPlaneMotion` with 4DGS's learning rates and regularisers."""

    moves = True

    def __init__(self, extent: Extent, settings: TrainSettings, generator: torch.Generator) -> None:
        super().__init__(hexplane_shape(extent, settings), extent.low, extent.high, extent.scale, generator)
        self.settings = settings

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """Planes and MLP."""
        s = self.settings
        return {
            "grid": (list(self.planes.parameters()), Decay(s.grid_rate, s.grid_rate_last)),
            "deformation": (self.mlp(), Decay(s.deformation_rate, s.deformation_rate_last)),
        }

    def regularizer(self) -> Tensor:
        """w_tv * plane TV + w_smooth * time smoothness + w_sparse * time sparsity."""
        s, space, time = self.settings, list(self.planes.space), list(self.planes.time)
        smooth = s.smooth_weight * time_smoothness(time) + s.sparse_weight * time_sparsity(time)
        return s.tv_weight * plane_tv(space) + smooth


def hexplane_shape(extent: Extent, settings: TrainSettings) -> HexPlaneShape:
    """As fine as the pictures and the clip ask: spatial cells by the view's width, time cells by the clip's length."""
    finest = max(2, round(extent.width / settings.cell_px))
    spatial = tuple(max(2, finest >> (settings.levels - 1 - level)) for level in range(settings.levels))
    times = max(4, round(extent.n_ticks / settings.cell_ticks) + 1)
    return HexPlaneShape(spatial, times, settings.features, settings.mlp_width)


MOTIONS: dict[str, Callable[[Extent, TrainSettings, torch.Generator], Motion]] = {
    "static": lambda extent, settings, generator: Static(),
    "hexplane": HexPlane4DGS,
}
