"""The motion part of a recipe: how Gaussians move. A new model is one file and one line in `MOTIONS`."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.motion.base import Extent, Motion
from spike4dgs.method.motion.hexplane import HexPlaneMotion, HexPlaneShape, plane_tv, time_smoothness, time_sparsity
from spike4dgs.method.motion.spacetime import Paths, Spacetime, SpacetimeLite
from spike4dgs.method.settings import TrainSettings
from spike4dgs.method.splat import Splats


class Static(Motion):
    """Nothing moves."""

    moves = False

    def splats(self, gaussians: Gaussians, t: float) -> Splats:
        """The same at all times."""
        return gaussians.splats()


class HexPlane4DGS(HexPlaneMotion, Motion):
    """`hexplane.HexPlaneMotion` with 4DGS's learning rates and regularisers."""

    def __init__(self, extent: Extent, settings: TrainSettings, generator: torch.Generator) -> None:
        super().__init__(hexplane_shape(extent, settings), extent.low, extent.high, extent.scale, generator)
        self.settings = settings

    def splats(self, gaussians: Gaussians, t: float) -> Splats:
        """The deformed Gaussians."""
        return self.deform(gaussians, t).splats()

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
    """As fine as the images and the clip ask: spatial cells by the view's width, time cells by the clip's length."""
    finest = max(2, round(extent.width / settings.cell_px))
    spatial = tuple(max(2, finest >> (settings.levels - 1 - level)) for level in range(settings.levels))
    times = max(4, round(extent.n_ticks / settings.cell_ticks) + 1)
    return HexPlaneShape(spatial, times, settings.features, settings.mlp_width)


# Step counts of the publications, in this trainer's steps of four images: a static 3DGS sees 30,000 single images,
# 4DGS's preset for several views 3,000 and 15,000. STG sees 30,000 pairs of images and densifies 6 or 12 times, which
# is 7 times here.
PUBLISHED: dict[str, dict[str, int]] = {
    "static": {"coarse_steps": 7500},
    "hexplane": {"coarse_steps": 750, "fine_steps": 3750},
    **dict.fromkeys(("spacetime", "spacetime-lite"), {"coarse_steps": 0, "fine_steps": 15000, "refine_every": 1250}),
}

MOTIONS: dict[str, Callable[[Extent, TrainSettings, torch.Generator], Motion]] = {
    "static": lambda extent, settings, generator: Static(),
    "hexplane": HexPlane4DGS,
    "spacetime": Spacetime,
    "spacetime-lite": SpacetimeLite,
    "paths": Paths,
}
