"""The axes of a chart: from values to pixels, with ticks that people read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

_GAP = 0.09  # share of a logarithmic axis below its smallest power, where a zero stands
_ROOM = 0.04  # share of a linear axis beyond the values


@dataclass(frozen=True)
class Scale:
    """An axis: `low` and `high` are values, or their logarithms. Exact twins have no error: a log axis shows zeros."""

    log: bool
    low: float
    high: float
    zero: bool  # the axis is logarithmic and has zeros

    def at(self, value: float) -> float:
        """Return the place of a value, 0 to 1."""
        start = _GAP if self.zero else 0.0
        if self.log and value <= 0:
            return 0.0
        along = ((math.log10(value) if self.log else value) - self.low) / (self.high - self.low)
        return start + (1 - start) * along

    def ticks(self) -> list[float]:
        """Return three to seven values to name."""
        if not self.log:
            step = _nice((self.high - self.low) / 4)
            first = math.ceil(self.low / step - 1e-9)
            return [k * step for k in range(first, math.floor(self.high / step + 1e-9) + 1)]
        low, high = math.ceil(self.low - 1e-9), math.floor(self.high + 1e-9)
        step = max(1, math.ceil((high - low) / 5))
        powers = [10.0**k for k in range(low, high + 1, step)]
        if self.high - self.low <= 2:
            inside = (m * 10.0**k for k in range(low - 1, high + 1) for m in (1, 2, 5))
            powers = [v for v in inside if self.low - 1e-9 <= math.log10(v) <= self.high + 1e-9]
        return [0.0] * self.zero + powers


def scale_of(values: Sequence[float], log: bool) -> Scale:
    """Return an axis that shows all values; negative ones are not for a logarithmic axis."""
    if log and any(v > 0 for v in values):
        powers = [math.log10(v) for v in values if v > 0]
        low, high = min(powers), max(powers)
        room = max(0.2, _ROOM * (high - low))  # a range of 0.4 has a 1, a 2 or a 5 in it
        low, high = low - room, high + room
        if high - low > 2:  # whole powers at both ends
            low, high = math.floor(low + 0.3), math.ceil(high - 0.3)
            low, high = min(low, min(powers) - room), max(high, max(powers) + room)
        return Scale(True, low, high, any(v <= 0 for v in values))
    low, high = min(0.0, *values, 0.0), max(0.0, *values, 0.0)
    if low == high:
        return Scale(False, 0.0, 1.0, False)
    room = _ROOM * (high - low)
    return Scale(False, low - (room if low < 0 else 0.0), high + room, False)


def short(value: float) -> str:
    """Return a number of three digits at most, such as 0, 0.25, 12, 3000, 2e-7."""
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    mantissa, _, power = f"{value:.1e}".partition("e")
    return f"{mantissa.removesuffix('.0')}e{int(power)}"


def _nice(step: float) -> float:
    power = 10.0 ** math.floor(math.log10(step))
    return float(min((m * power for m in (1, 2, 5, 10)), key=lambda s: abs(s - step)))
