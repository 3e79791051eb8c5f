"""The slow, obvious image makers: float64 or 50 digits, one pixel after the other, straight from the definitions.

The fast makers are tested against these, and the report of hard cases compares them. Arguments: spikes [T, H, W] of 0
and 1, upright and unpacked, and a tick; they return spikes per tick [H, W]. `lost` are ticks [T] that were filled, or
[T, H, W] those of each pixel that are in doubt.
"""

import math
from collections.abc import Sequence
from decimal import Decimal, localcontext

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.images.adaptive import AdaptiveSettings, half_windows
from spike4dgs.method.images.intervals import IntervalSettings

Spikes = NDArray[np.generic]
Lost = NDArray[np.bool_] | None
PUBLISHED = Decimal("0.15"), Decimal("0.15"), Decimal(1), Decimal(10)  # TFSTP's u0, f, D, F


def stream_of(spikes: Spikes, bottom_up: bool = True, lost: Lost = None, certain: Lost = None) -> SpikeStream:
    """Return spikes [T, H, W] as a stream in memory; `certain` [T, H, W] says where lost ticks are."""
    filled = () if lost is None else tuple(Gap("cam_00", int(t), 1, "lost") for t in np.flatnonzero(lost))
    sure = None if certain is None else pack(certain[lost], bottom_up)
    size = spikes.shape[2], spikes.shape[1], 20_000.0, bottom_up
    return SpikeStream(pack(spikes, bottom_up), *size, filled=filled, certain=sure)


def _of_pixels(spikes: Spikes, lost: Lost) -> NDArray[np.bool_]:
    """Return which ticks are in doubt [T, H, W]."""
    if lost is None or lost.ndim == 3:
        return np.zeros(spikes.shape, bool) if lost is None else lost
    return np.broadcast_to(lost[:, None, None], spikes.shape)


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


def _certain(spikes: Spikes, doubt: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the ticks of the spikes of one pixel [T] that are not in doubt."""
    return np.flatnonzero((spikes != 0) & ~doubt)


def _window(spikes: Spikes, tick: int, half: float, doubt: NDArray[np.bool_]) -> tuple[float | None, NDArray[np.int64]]:
    """Return the rate of one pixel [T] over a window, None with fewer than two spikes, and its certain spikes."""
    t = _certain(spikes, doubt)
    near = (t >= tick - half) & (t < tick + half)
    near |= (t == t[t < tick].max(initial=-1)) | (t == t[t >= tick].min(initial=len(spikes)))
    t = t[near]
    return np.count_nonzero(spikes[t[0] : t[-1]]) / (t[-1] - t[0]) if len(t) > 1 else None, t


def slow_levels(spikes: Spikes, tick: int, settings: AdaptiveSettings, lost: Lost) -> NDArray[np.int64]:
    """Return each pixel's longest window that a constant rate explains, [H, W]; of neighbours, the shortest."""
    n, height, width = spikes.shape
    halves, reach = half_windows(n, settings), settings.shared_px // 2
    level, in_doubt = np.full((height, width), len(halves) - 1), _of_pixels(spikes, lost)
    for y, x in np.ndindex(height, width):
        known = []
        for s, half in enumerate(halves):
            rate, t = _window(spikes[:, y, x], tick, half, in_doubt[:, y, x])
            if rate is None:
                continue
            k, length, doubtful = len(t) - 1, t[-1] - t[0], int(in_doubt[t[0] : t[-1], y, x].sum())
            likely = int(np.count_nonzero(spikes[t[0] : t[-1], y, x]))
            fewest, most = (max(k, likely - 1), min(k + doubtful, likely + 1)) if doubtful else (k, k)
            known.append((fewest / (length + 1), most / (length - 1) if length > 1 else math.inf))
            if max(a for a, _ in known) > min(b for _, b in known):
                level[y, x] = s - 1
                break
    shared = np.empty_like(level)
    for y, x in np.ndindex(height, width):
        shared[y, x] = level[max(0, y - reach) : y + reach + 1, max(0, x - reach) : x + reach + 1].min()
    return shared


def slow_adaptive(spikes: Spikes, tick: int, settings: AdaptiveSettings | None = None, lost: Lost = None) -> Float64:
    """Return the rate over the longest window that a constant rate explains, pixel by pixel, window by window."""
    settings = settings or AdaptiveSettings()
    levels = slow_levels(spikes, tick, settings, lost)
    return _slow_rates(spikes, tick, half_windows(len(spikes), settings), levels, lost)


def _slow_rates(spikes: Spikes, tick: int, halves: Float64, level: NDArray[np.int64], lost: Lost) -> Float64:
    """Return each pixel's rate over its window, or over the next longer one that has two spikes."""
    image, doubt = np.asarray(spikes.astype(np.float64).sum(axis=0) / len(spikes)), _of_pixels(spikes, lost)
    for y, x in np.ndindex(image.shape):
        rates = [_window(spikes[:, y, x], tick, half, doubt[:, y, x])[0] for half in halves[level[y, x] :]]
        image[y, x] = next((r for r in rates if r is not None), image[y, x])
    return image


def slow_intervals(
    spikes: Spikes, tick: int, settings: IntervalSettings | None = None, lost: Lost = None
) -> tuple[Float64, Float64, Float64]:
    """Return the rates, the first and last instants of their spans [2, H, W] in ticks from `tick`, and their doubts."""
    s = settings or IntervalSettings()
    halves, level = half_windows(len(spikes), s), slow_levels(spikes, tick, s, lost)
    image, spans = _slow_rates(spikes, tick, halves, level, lost), np.empty((2, *spikes.shape[1:]))
    spans[0], spans[1], doubt, doubts = -s.half, s.half, _of_pixels(spikes, lost), np.zeros((3, *image.shape))
    for y, x in np.ndindex(image.shape):
        window = float(halves[level[y, x]])
        if window >= s.still or level[y, x] == len(halves) - 1:
            continue
        # Half a span is a float32 number: 4.000000000000001 would tell apart two spikes that are equally near.
        half = float(np.float32(min(s.half, max(s.shortest, window / s.growth))))
        if found := _measured(spikes[:, y, x], tick, half, doubt[:, y, x]):
            image[y, x], spans[:, y, x], doubts[:, y, x] = found
    return image, spans, doubts


def _measured(
    spikes: Spikes, tick: int, half: float, doubt: NDArray[np.bool_]
) -> tuple[float, tuple[float, float], tuple[float, float, float]] | None:
    """Return rate, span and doubts of a pixel; None with fewer than two certain spikes."""
    fired = _certain(spikes, doubt)
    found = _between_spikes(fired, tick - half, tick + half, tick)
    if found is None:
        return None
    (i, j), (first, last) = found, fired[list(found)]
    span, length, doubtful = (first + 0.5 - tick, last + 0.5 - tick), last - first, int(doubt[first:last].sum())
    doubts = (doubtful, 1 / length, (j - i) / length) if doubtful else (0.0, 0.0, 0.0)
    return (j - i) / (length - doubtful), span, doubts


def _between_spikes(fired: NDArray[np.int64], start: float, stop: float, tick: int) -> tuple[int, int] | None:
    """Return the numbers of a pixel's two spikes nearest to two instants; None with fewer than two spikes."""
    instants = fired + 0.5
    if len(instants) < 2:
        return None
    i, j = (int(np.argmin(abs(instants - end))) for end in (start, stop))
    if i == j:
        i, j = (i - 1, j) if (instants[i] > tick and i > 0) or j + 1 == len(instants) else (i, j + 1)
    return i, j


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
