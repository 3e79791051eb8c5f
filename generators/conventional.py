"""A conventional 60 fps camera of the same scene: each frame is the mean radiance over its exposure (real blur).

The mean is exact for the simulator's curve between keys (see `sensor.model`) up to its clamp: the curve's integral over
whole key intervals is their trapezoid plus (m1 - m2) n / 12, and an exposure that begins or ends inside an interval
uses the mean radiance of each tick.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from spike4dgs.generators.sensor.model import Float32

FPS = 60
EXPOSURE_S = 1 / 120  # a shutter of 180 degrees


def exposures(
    keys: Sequence[Float32], key_ticks: Sequence[int], n_ticks: int, rate_hz: int
) -> Iterator[tuple[int, Float32]]:
    """Yield (tick at which the exposure begins, mean radiance [H, W]) of each frame whose exposure fits into the clip.

    `keys` are read in ascending order, each exposure's keys once. A clip shorter than one exposure has no frame.
    """
    length = round(EXPOSURE_S * rate_hz)
    frame = 0
    while (start := round(frame * rate_hz / FPS)) + length <= n_ticks:
        yield start, _mean(keys, key_ticks, start, start + length)
        frame += 1


def _mean(keys: Sequence[Float32], key_ticks: Sequence[int], start: int, end: int) -> Float32:
    """Return the mean radiance of ticks start .. end - 1."""
    ticks = np.asarray(key_ticks)
    k = int(np.searchsorted(ticks, start, side="right")) - 1
    last = len(ticks) - 1
    around = [np.asarray(keys[min(max(k + i, 0), last)], dtype=np.float64) for i in (-1, 0, 1)]
    total = np.zeros_like(around[1])
    while ticks[k] < end:
        p0, p1, p2 = around
        p3 = np.asarray(keys[min(k + 2, last)], dtype=np.float64)
        n = ticks[k + 1] - ticks[k]
        m1 = (p2 - p0) * (n / (ticks[k + 1] - ticks[max(k - 1, 0)]))
        m2 = (p3 - p1) * (n / (ticks[min(k + 2, last)] - ticks[k]))
        a, b = max(start, ticks[k]) - ticks[k], min(end, ticks[k + 1]) - ticks[k]
        total += n * (_integral(p1, p2, m1, m2, b / n) - _integral(p1, p2, m1, m2, a / n))
        around, k = [p1, p2, p3], k + 1
    return (total / (end - start)).astype(np.float32)


def _integral(p1: np.ndarray, p2: np.ndarray, m1: np.ndarray, m2: np.ndarray, u: float) -> np.ndarray:
    """Return the integral of the cubic through p1 and p2 with tangents m1 and m2, from 0 to u."""
    d = p2 - p1
    a2, a3 = 3 * d - 2 * m1 - m2, m1 + m2 - 2 * d
    return np.asarray(u * (p1 + u * (m1 / 2 + u * (a2 / 3 + u * a3 / 4))))
