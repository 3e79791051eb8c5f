"""The motion part of a recipe: how Gaussians move. A new model is one file and one line in `MOTIONS`."""

from __future__ import annotations

import torch

from spike4dgs.benchmark.plugins import find_plugins
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.motion.base import Extent, Motion
from spike4dgs.method.motion.hexplane import HexPlaneMotion
from spike4dgs.method.motion.paths import Paths
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


GROUP = "spike4dgs.motions"  # entry points of other packages, and of `baselines`
MOTIONS: dict[str, type[Motion]] = {"static": Static, "hexplane": HexPlaneMotion, "paths": Paths}


def motion_named(name: str) -> type[Motion]:
    """Return a motion of this package or of another one. Raises KeyError for an unknown name."""
    if name in MOTIONS:
        return MOTIONS[name]
    found: type[Motion] = find_plugins(GROUP, "motion", lambda *_: None, MOTIONS)[name].value
    return found
