"""Worlds that are built once for all tests of a process: one takes up to half a second."""

from functools import lru_cache

from spike4dgs.generators.worlds import WORLDS, WorldScene


@lru_cache(maxsize=16)
def built(name: str, variant: int = 0, duration_s: float = 0.02) -> WorldScene:
    """Return a world of seed 0."""
    return WORLDS[name].build(0, variant, duration_s)
