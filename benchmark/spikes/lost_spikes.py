"""Lost spikes: what a pixel may have fired in ticks that the recording lacks and `repair` has filled.

Let two of a pixel's recorded spikes be T ticks apart, with k - 1 recorded spikes between them, and between them D lost
ticks that were filled with m spikes. The pixel gathered k thresholds or more, and no more than k + D, for a tick holds
one spike at most. Of its rate two estimates are known:

    (k + m) / T,    right under constant light, where hardly any gap is filled with a wrong number;
    k / (T - D),    what was recorded over the time of the recording, right on average whatever the light does.

Both spikes are known to the tick, and a spike too many or too few was filled now and then. So under constant light the
rate lies

    between max(k, k + m - 1) / (T + 1) and min(k + D, k + m + 1) / (T - 1).

A filled spike is known to no tick: it ends no span. Where no tick is lost all this is the rate of a whole recording, to
the last bit.
"""

from __future__ import annotations

import numpy as np

from spike4dgs.benchmark.arrays import Int64, UInt32, UInt64
from spike4dgs.benchmark.spikes.bits import kernel
from spike4dgs.benchmark.spikes.trains import count_before


def recorded_runs(lost: Int64, start: int, stop: int) -> tuple[Int64, Int64]:
    """Return the runs of recorded ticks that reach into [start, stop): their first ticks, and the ticks after them.

    `lost` is that of `SpikeTrains`.
    """
    edges = np.diff(np.concatenate([[1], np.diff(lost), [1]]))
    starts, stops = np.flatnonzero(edges < 0), np.flatnonzero(edges > 0)
    near = (stops > start) & (starts < stop)
    return starts[near], stops[near]


@kernel
def filled_between(lost: Int64, words: UInt64, before: UInt32, pixel: int, first: int, last: int) -> int:
    """Return the spikes that a pixel's lost ticks in [first, last) were filled with; for the rest see `SpikeTrains`."""
    a, b = lost[first], lost[last]
    if a == b:
        return 0
    return count_before(words, before, pixel, b) - count_before(words, before, pixel, a)


@kernel
def fewest(k: int, filled: int, lost: int) -> int:
    """Return the thresholds that a pixel gathered at least: k are certain, beside those filled in `lost` ticks."""
    return k + max(filled - 1, 0) if lost > 0 else k


@kernel
def most(k: int, filled: int, lost: int) -> int:
    """Return the thresholds that a pixel gathered at most."""
    return k + min(filled + 1, lost)
