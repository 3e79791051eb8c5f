"""The motion part of a recipe: how Gaussians move. A new model is one file and one line in `MOTIONS`."""

from __future__ import annotations

from spike4dgs.benchmark.plugins import find_plugins
from spike4dgs.method.motion.base import Motion
from spike4dgs.method.motion.hexplane import HexPlaneMotion
from spike4dgs.method.motion.paths import Paths
from spike4dgs.method.motion.static import Static

GROUP = "spike4dgs.motions"  # entry points of other packages, and of `baselines`
MOTIONS: dict[str, type[Motion]] = {"static": Static, "hexplane": HexPlaneMotion, "paths": Paths}


def motion_named(name: str) -> type[Motion]:
    """Return a motion of this package or of another one. Raises KeyError for an unknown name."""
    if name in MOTIONS:
        return MOTIONS[name]
    found: type[Motion] = find_plugins(GROUP, "motion", lambda *_: None, MOTIONS)[name].value
    return found
