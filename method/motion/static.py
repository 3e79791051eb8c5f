"""The motion `static`: nothing moves."""

from __future__ import annotations

import torch

from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.motion.base import Extent, Motion
from spike4dgs.method.settings import Settings
from spike4dgs.method.splat import Splats


class Static(Motion):
    """Gaussians that are the same at all times; it has no settings."""

    label = "3DGS, nothing moves"
    published = {"trainer.coarse_steps": 7500}  # a static 3DGS sees 30,000 single images: steps of four here
    moves = False

    def __init__(self, extent: Extent, settings: Settings, generator: torch.Generator) -> None:
        super().__init__()

    def splats(self, gaussians: Gaussians, t: float) -> Splats:
        """Return the Gaussians as they are."""
        return gaussians.splats()
