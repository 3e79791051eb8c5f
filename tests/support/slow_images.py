"""The slow, obvious image makers: float64 or 50 digits, one pixel after the other, straight from the definitions.

The fast makers are tested against these, and the report of hard cases compares them. Arguments: spikes [T, H, W] of 0
and 1, upright and unpacked, and a tick; they return spikes per tick [H, W].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal, localcontext

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.images.adaptive import AdaptiveSettings, half_windows
from spike4dgs.method.images.intervals import IntervalSettings

Spikes = NDArray[np.generic]
PUBLISHED = Decimal("0.15"), Decimal("0.15"), Decimal(1), Decimal(10)  # TFSTP's u0, f, D, F


def stream_of(spikes: Spikes, bottom_up: bool = True) -> SpikeStream:
    """Return spikes [T, H, W] as a stream in memory."""
    return SpikeStream(pack(spikes, bottom_up), spikes.shape[2], spikes.shape[1], 20_000.0, bottom_up)


def slow_tfp(spikes: Spikes, tick: int, half_window: int) -> Float64:
    """Return the mean of the spikes in [tick - half_window, tick + half_window), cut at the clip's ends."""
    window = spikes[max(0, tick - half_window) : tick + half_window]
    return np.asarray(window.astype(np.float64).mean(axis=0))


def slow_tfi(spikes: Spikes, tick: int) -> Float64:
    """Return the inverse of the interval between the spikes around the start of a tick."""
    n = len(spikes)
    image = np.zeros(spikes.shape[1:])
    for y, x in np.ndindex(image.shape):
        fired = np.flatnonzero(spikes[:, y, x])
        if len(fired) == 0:
            continue
        before, after = fired[fired < tick], fired[fired >= tick]
        if len(before) and len(after):
            interval = after[0] - before[-1]
        elif len(fired) == 1:
            interval = n
        elif len(after):  # the interval reaches over the beginning: at least after[0] + 1 ticks of it were seen
            interval = max(after[1] - after[0], after[0] + 1)
        else:
            interval = max(before[-1] - before[-2], n - before[-1])
        image[y, x] = 1 / interval
    return image


def _window(spikes: Spikes, tick: int, half: float) -> tuple[float | None, NDArray[np.int64]]:
    """Return the rate of one pixel [T] over a window, None with fewer than two spikes, and the window's spikes."""
    t = np.flatnonzero(spikes)
    near = (t >= tick - half) & (t < tick + half)
    near |= (t == t[t < tick].max(initial=-1)) | (t == t[t >= tick].min(initial=len(spikes)))
    t = t[near]
    return (len(t) - 1) / (t[-1] - t[0]) if len(t) > 1 else None, t


def slow_levels(spikes: Spikes, tick: int, settings: AdaptiveSettings) -> NDArray[np.int64]:
    """Return each pixel's longest window that a constant rate explains, [H, W]; of neighbours, the shortest."""
    n, height, width = spikes.shape
    halves, reach = half_windows(n, settings), settings.shared_px // 2
    level = np.full((height, width), len(halves) - 1)
    for y, x in np.ndindex(height, width):
        known = []
        for s, half in enumerate(halves):
            rate, t = _window(spikes[:, y, x], tick, half)
            if rate is None:
                continue
            k, length = len(t) - 1, t[-1] - t[0]
            known.append((k / (length + 1), k / (length - 1) if length > 1 else math.inf))
            if max(a for a, _ in known) > min(b for _, b in known):
                level[y, x] = s - 1
                break
    shared = np.empty_like(level)
    for y, x in np.ndindex(height, width):
        shared[y, x] = level[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1].min()
    return shared


def slow_adaptive(spikes: Spikes, tick: int, settings: AdaptiveSettings | None = None) -> Float64:
    """Return the rate over the longest window that a constant rate explains, pixel by pixel, window by window."""
    settings = settings or AdaptiveSettings()
    return _slow_rates(spikes, tick, half_windows(len(spikes), settings), slow_levels(spikes, tick, settings))


def _slow_rates(spikes: Spikes, tick: int, halves: Float64, level: NDArray[np.int64]) -> Float64:
    """Return each pixel's rate over its window, or over the next longer one that has two spikes."""
    image = np.asarray(spikes.astype(np.float64).sum(axis=0) / len(spikes))
    for y, x in np.ndindex(image.shape):
        rates = [_window(spikes[:, y, x], tick, half)[0] for half in halves[level[y, x] :]]
        image[y, x] = next((r for r in rates if r is not None), image[y, x])
    return image


def slow_intervals(spikes: Spikes, tick: int, settings: IntervalSettings | None = None) -> tuple[Float64, Float64]:
    """Return the rates and the first and last instants of their spans [2, H, W] in ticks from `tick`."""
    s = settings or IntervalSettings()
    halves, level = half_windows(len(spikes), s), slow_levels(spikes, tick, s)
    image, spans = _slow_rates(spikes, tick, halves, level), np.empty((2, *spikes.shape[1:]))
    spans[0], spans[1] = -s.half, s.half
    for y, x in np.ndindex(image.shape):
        window = float(halves[level[y, x]])
        if window >= s.still or level[y, x] == len(halves) - 1:
            continue
        # Half a span is a float32 number: 4.000000000000001 would tell apart two spikes that are equally near.
        half = float(np.float32(min(s.half, max(s.shortest, window / s.growth))))
        if found := _between_spikes(spikes[:, y, x], tick, half):
            image[y, x], spans[:, y, x] = found[0], found[1:]
    return image, spans


def _between_spikes(spikes: Spikes, tick: int, half: float) -> tuple[float, float, float] | None:
    """Return rate, first and last instant of one pixel [T] between the spikes nearest to tick -+ half.

    None with fewer than two spikes.
    """
    instants = np.flatnonzero(spikes) + 0.5
    if len(instants) < 2:
        return None
    i, j = (int(np.argmin(abs(instants - end))) for end in (tick - half, tick + half))
    if i == j:
        i, j = (i - 1, j) if (instants[i] > tick and i > 0) or j + 1 == len(instants) else (i, j + 1)
    return (j - i) / (instants[j] - instants[i]), instants[i] - tick, instants[j] - tick


def slow_tfstp(spikes: Spikes, tick: int) -> Float64:
    """Return TFSTP's rates with the published constants."""
    n, rates = len(spikes), np.zeros(spikes.shape[1:])
    for y, x in np.ndindex(rates.shape):
        rates[y, x] = slow_tfstp_pixel(np.flatnonzero(spikes[:, y, x]).tolist(), n, tick)
    return rates


def slow_tfstp_pixel(
    fired: Sequence[int], n: int, tick: int, constants: tuple[Decimal, Decimal, Decimal, Decimal] = PUBLISHED
) -> float:
    """Return TFSTP of one pixel, from the published equations: the whole history, both inversions as printed."""
    U0, f, D, F = constants

    def update(R: Decimal, u: Decimal, d: int) -> tuple[Decimal, Decimal]:
        return (1 - (1 - R * (1 - u)) * (-d / D).exp(), U0 + (u + f * (1 - u) - U0) * (-d / F).exp())

    before, after = [t for t in fired if t < tick], [t for t in fired if t >= tick]
    if len(fired) < 2:
        return len(fired) / n
    if not before:
        return 1 / max(after[1] - after[0], after[0] + 1)
    gaps = [int(gap) for gap in np.diff(before)]
    if after:
        gaps.append(after[0] - before[-1])
    elif n - before[-1] >= gaps[-1]:
        gaps.append(n - before[-1])
    with localcontext() as context:
        context.prec = 20 + int(max(gaps)) // 2  # 1 - R is exp(-d): long intervals need as many digits
        R, u = Decimal(1), U0
        for _ in range(160 // int(gaps[0]) + 4):  # until the first interval is at rest
            R, u = update(R, u, int(gaps[0]))
        for gap in gaps[1:]:
            R, u = update(R, u, int(gap))
        d_r = -D * ((1 - R) / (1 - R * (1 - u))).ln()
        d_u = -F * ((u - U0) / (f - U0 + u * (1 - f))).ln()
        return float((1 / d_r + 1 / d_u) / 2)
