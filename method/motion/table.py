"""The motion part of a recipe: how Gaussians move. A new model is one file and one line in `MOTIONS`."""

from __future__ import annotations

from spike4dgs.baselines.stg.spacetime import Spacetime, SpacetimeLite
from spike4dgs.method.motion.base import Extent, Motion
from spike4dgs.method.motion.hexplane import HexPlaneMotion
from spike4dgs.method.motion.paths import Paths
from spike4dgs.method.motion.static import Static

MOTIONS: dict[str, type[Motion]] = {
    "static": Static,
    "hexplane": HexPlaneMotion,
    "spacetime": Spacetime,
    "spacetime-lite": SpacetimeLite,
    "paths": Paths,
}

__all__ = ["MOTIONS", "Extent", "Motion"]
