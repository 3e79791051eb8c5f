"""The hard cases of this room."""

from __future__ import annotations

from spike4dgs.baselines.hard_cases import fits, images
from spike4dgs.benchmark.hard_cases.case import Case


def hard_cases() -> list[Case]:
    """Return the cases of images from spikes, of fits that must stay finite, and of clocks."""
    return [*images.cases(), *fits.cases()]
