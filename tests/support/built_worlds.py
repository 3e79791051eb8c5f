"""Worlds that are built once for all tests of a process: one takes up to half a second; and their scenes, forgotten."""

import gc
from functools import lru_cache

from spike4dgs.generators.rendering.mitsuba_scene import mitsuba_scene
from spike4dgs.generators.worlds import WORLDS, WorldScene


def built(name: str, variant: int = 0, duration_s: float = 0.02) -> WorldScene:
    """Return a world of seed 0."""
    return _built(name, variant, duration_s)


@lru_cache(maxsize=16)  # by all three, also where a caller leaves some out
def _built(name: str, variant: int, duration_s: float) -> WorldScene:
    return WORLDS[name].build(0, variant, duration_s)


def forget_scenes() -> None:
    """Leave no scene of Mitsuba's in memory that nobody uses: LLVM compiles every kernel for all that are there."""
    if mitsuba_scene.cache_info().currsize:
        mitsuba_scene.cache_clear()
        gc.collect()
