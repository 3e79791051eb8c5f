"""The hard cases of this room."""

from __future__ import annotations

from spike4dgs.benchmark.hard_cases import geometry, metrics, spikes
from spike4dgs.benchmark.hard_cases.case import Case


def hard_cases() -> list[Case]:
    """Return the cases of spike streams, metrics, cameras and image files."""
    return [*spikes.cases(), *metrics.cases(), *geometry.cases()]
