"""Worlds that are built once for all tests of a process: one takes up to a second."""

from functools import lru_cache

from spike4dgs.generators.worlds import WORLDS, WorldScene


def built(name: str, variant: int = 0, duration_s: float = 0.02) -> WorldScene:
    """Return a world of seed 0."""
    return _built(name, variant, duration_s)


@lru_cache(maxsize=16)  # by all three, also where a caller leaves some out
def _built(name: str, variant: int, duration_s: float) -> WorldScene:
    return WORLDS[name].build(0, variant, duration_s)
