"""Likely spikes: which of a few lost ticks hold a pixel's spikes, and whether that is certain.

A lost spike can only lie in a lost tick. So D lost ticks between the same two recorded spikes leave 2^D trains, each
with its intervals, and most of them change as no light does. A train is as likely as its intervals are even:

    log L(i + 1) = log L(i) + S e(i)                    intervals L, normal deviates e
    t(i + 1) = t(i) + L(i)                              instants of spikes, each within half a tick of its own tick

with S, how soon light changes there, one of CHANGES, each as likely. Linear about the intervals that are seen, this is
a normal model. A filter from either side takes CONTEXT intervals beyond the lost ticks, or more of a bright pixel. The
first instant and the first interval may be anything. The two meet at the second recorded spike: time has no direction.

Of the 2^D trains the likeliest is taken. What a lost tick then holds is certain where all the trains in which it holds
something else have a probability below CERTAIN.
"""

from __future__ import annotations

import math

import numpy as np

from spike4dgs.benchmark.arrays import Float64, Int64, UInt8
from spike4dgs.benchmark.spikes.bits import find_spike, kernel

MOST = 5  # lost ticks between two recorded spikes: each doubles the trains
CONTEXT, NEAR_TICKS = 4, 20  # intervals on either side, and more as far as these ticks: bright pixels' are short
CHANGES = (0.03, 0.1, 0.3, 0.6)  # of the log interval from one to the next
TICK = 1 / 12  # ticks^2: variance of an instant within its tick
UNKNOWN = 4.0  # variance of the log interval where a side has none: the longest that can be, or e^2 times less or more
CERTAIN = 0.02  # probability of being wrong below which a lost tick is as good as recorded
TIE = 1e-9  # of a log likelihood: of trains that are as likely the first counts, however sums were rounded


@kernel
def likely_spikes(packed: UInt8, pixel: int, before: int, after: int, lost: Int64) -> tuple[int, int]:
    """Return in which of the ticks `lost` [D] between two spikes a pixel is likely to fire, and where that is certain.

    Both are bits, the first tick's the lowest. They are -1 and 0 where no interval on either side is known, so that
    nothing tells. D is at most MOST. Ticks beyond the two spikes are taken as they are.
    """
    left, right = np.empty(CONTEXT + NEAR_TICKS, np.int64), np.empty(CONTEXT + NEAR_TICKS, np.int64)
    n_left, n_right = _intervals(packed, pixel, before, -1, left), _intervals(packed, pixel, after, 1, right)
    if n_left + n_right == 0:
        return -1, 0
    trains = 1 << len(lost)
    score, steps = np.empty((len(CHANGES), trains)), np.empty(len(lost) + 1)
    widest = math.log(after - before)
    for c in range(len(CHANGES)):
        change = CHANGES[c] ** 2
        start, end = _filtered(left, n_left, change, widest), _filtered(right, n_right, change, widest)
        for train in range(trains):
            m, at = 0, before
            for d in range(len(lost)):
                if train >> d & 1:
                    steps[m] = lost[d] - at
                    m, at = m + 1, lost[d]
            steps[m] = after - at
            score[c, train] = _log_likelihood(start, end, steps[: m + 1], change)
    highest = score.max()
    best, most, total = 0, 0.0, 0.0
    for train in range(trains):
        share = 0.0
        for c in range(len(CHANGES)):
            share += math.exp(score[c, train] - highest)
        score[0, train] = share
        total += share
        if share > most * (1 + TIE):
            best, most = train, share
    sure = 0
    for d in range(len(lost)):
        other = 0.0
        for train in range(trains):
            if (train ^ best) >> d & 1:
                other += score[0, train]
        if other < CERTAIN * total:
            sure |= 1 << d
    return best, sure


@kernel
def _intervals(packed: UInt8, pixel: int, first: int, step: int, found: Int64) -> int:
    """Set the intervals beyond a spike in direction `step`, the nearest first, and return how many there are."""
    at = first
    for i in range(len(found)):
        if i >= CONTEXT and abs(at - first) >= NEAR_TICKS:
            return i
        following = find_spike(packed, pixel, at + step, step)
        if following < 0:
            return i
        found[i] = abs(following - at)
        at = following
    return len(found)


@kernel
def _step(
    state: tuple[float, float, float, float, float, float], ticks: float, change: float
) -> tuple[float, float, float, float, float, float]:
    """Return the state at the next spike, `ticks` later, before its tick is known.

    A state is the spike's instant from its tick in the direction of time, the log of the last interval, their variances
    and covariance (instant, both, log interval), and the log likelihood of the ticks so far.
    """
    instant, log, a, b, c, known = state
    c += change
    return instant + ticks * (log - math.log(ticks)), log, a + 2 * ticks * b + ticks**2 * c, b + ticks * c, c, known


@kernel
def _seen(
    state: tuple[float, float, float, float, float, float],
) -> tuple[float, float, float, float, float, float]:
    """Return the state at a spike whose tick is known."""
    instant, log, a, b, c, known = state
    variance = a + TICK
    known -= (instant**2 / variance + math.log(2 * math.pi * variance)) / 2
    rest = TICK / variance
    return instant * rest, log - b / variance * instant, a * rest, b * rest, c - b * b / variance, known


@kernel
def _filtered(
    intervals: Int64, n: int, change: float, widest: float
) -> tuple[float, float, float, float, float, float]:
    """Return the state at the recorded spike next to the lost ticks, from n intervals beyond it, the nearest first."""
    if n == 0:
        return 0.0, widest, TICK, 0.0, UNKNOWN, 0.0
    ticks = float(intervals[n - 1])
    state = (0.0, math.log(ticks), TICK, TICK / ticks, 2 * TICK / ticks**2, 0.0)
    for i in range(n - 2, -1, -1):
        state = _seen(_step(state, float(intervals[i]), change))
    return state


@kernel
def _log_likelihood(
    start: tuple[float, float, float, float, float, float],
    end: tuple[float, float, float, float, float, float],
    steps: Float64,
    change: float,
) -> float:
    """Return the log likelihood of a train, but for a constant: of its steps from one filtered state to the other."""
    state = start
    for i in range(len(steps) - 1):
        state = _seen(_step(state, steps[i], change))
    instant, log, a, b, c, known = _step(state, steps[-1], change)
    back, later, x, y, z, beyond = end
    off, apart = instant + back, log - later  # `end` counts instants the other way
    a, b, c = a + x, b - y, c + z + change
    area = a * c - b * b
    square = (c * off**2 - 2 * b * off * apart + a * apart**2) / area
    return known + beyond - (square + math.log(area)) / 2 - math.log(2 * math.pi)
