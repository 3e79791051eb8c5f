"""The hard cases of this room."""

from __future__ import annotations

from spike4dgs.benchmark.hard_cases.case import Case
from spike4dgs.method.hard_cases import fits, splat, training


def hard_cases() -> list[Case]:
    """Return the cases of the rasteriser, the losses, the motions and the fits."""
    return [*splat.cases(), *training.cases(), *fits.cases()]
