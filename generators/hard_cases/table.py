"""The hard cases of this room."""

from __future__ import annotations

from spike4dgs.benchmark.hard_cases.case import Case
from spike4dgs.generators.hard_cases import sensor


def hard_cases() -> list[Case]:
    """Return the cases of the spike simulator and of events."""
    return sensor.cases()
