"""Bounded numbers. A file's number has a type and a range before anything is computed or allocated with it."""

from __future__ import annotations

from typing import Any

MAX_SIDE = 16384  # pixels of an image's width or height; cameras have a few hundred
MAX_TICKS = 10**12  # of a clip: more than a year at 20 kHz
MAX_HZ = 1e9  # ticks or frames per second
MAX_SECONDS = 1e9  # of a fit or a clip: 30 years
MAX_GAIN = 1e9  # spikes per tick of a pixel that sees white, and radiances
MAX_LENGTH = 1e9  # metres or pixels, of poses and intrinsics
_SHOWN = 60  # characters of a wrong value


def number(value: Any, low: float, high: float) -> float:
    """Return a finite number of [low, high] as float. Raises ValueError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{shown(value)} is no number from {low:g} to {high:g}")
    return float(value)


def positive(value: Any, high: float) -> float:
    """Return a number of (0, high] as float. Raises ValueError for anything else."""
    if (found := number(value, 0.0, high)) == 0:
        raise ValueError(f"{shown(value)} is not positive")
    return found


def whole(value: Any, low: int, high: int) -> int:
    """Return an integer of [low, high]; 3.0 is one. Raises ValueError for anything else."""
    if not (found := number(value, low, high)).is_integer():
        raise ValueError(f"{shown(value)} is no whole number")
    return value if isinstance(value, int) else int(found)


def shown(value: object) -> str:
    """Return a value in the form of an error message, cut where it is long."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # more digits than Python prints, or absurd depth
        text = "a value too large to print"
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
