"""Other sensors that film the same scene: a conventional camera of 60 fps, and an event camera.

A conventional 60 fps camera of the same scene: each frame is the mean radiance over its exposure (real blur).

The mean is exact for the simulator's curve between keys (see `sensor.model`) up to its clamp: the curve's integral over
whole key intervals is their trapezoid plus (m1 - m2) n / 12, and an exposure that begins or ends inside an interval
uses the mean radiance of each tick.

An event camera of the same scene: an event whenever a pixel's log radiance has changed by the threshold.

Contrast-threshold model without noise (as in ESIM, Rebecq et al. 2018). Each pixel stores the log radiance of its last
event, at first that of the first key. Whenever the log radiance is a whole threshold away, the pixel fires a positive
or negative event. Between keys log radiance is linear in time; times are microseconds, rounded down.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.scene.other_sensors import Events
from spike4dgs.benchmark.spikes.bits import kernel

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


THRESHOLD = 0.2  # of log radiance
_DARKEST = 1e-3  # lower radiances count as this one


def events(
    keys: Sequence[Float32], key_ticks: Sequence[int], n_ticks: int, rate_hz: int, threshold: float = THRESHOLD
) -> Events:
    """Return the events of a clip from radiance keys [H, W], read one at a time, up to tick `n_ticks`."""
    before = _log(keys[0])
    level = before.astype(np.float64)
    height, width = before.shape
    found = []
    for k in range(1, len(key_ticks)):
        if key_ticks[k - 1] >= n_ticks:
            break
        after = _log(keys[k])
        span_us = np.array([key_ticks[k - 1], key_ticks[k]]) * 1e6 / rate_hz
        room = int(np.ceil(np.abs(after - level) / threshold).sum()) + 1
        t, pixel, p = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.uint8)
        n = crossings(before.ravel(), after.ravel(), level.ravel(), span_us[0], span_us[1], threshold, t, pixel, p)
        order = np.lexsort((pixel[:n], t[:n]))
        found.append((t[:n][order], pixel[:n][order], p[:n][order]))
        before = after
    t, pixel, p = (np.concatenate([f[i] for f in found]) for i in range(3))
    inside = t < n_ticks * 1e6 / rate_hz
    y, x = np.divmod(pixel[inside], width)
    return Events(t[inside], x.astype(np.uint16), y.astype(np.uint16), p[inside])


def _log(image: Float32) -> NDArray[np.float64]:
    return np.log(np.maximum(np.asarray(image, dtype=np.float64), _DARKEST))


@kernel
def crossings(
    before: Any, after: Any, level: Any, start_us: Any, end_us: Any, threshold: Any, t: Any, pixel: Any, p: Any
) -> int:
    """Fill t, pixel and p with the events of one interval, pixel by pixel; advance `level`; return their number.

    before, after, level: log radiance [P] at the start, at the end, and of the last event.
    """
    n = 0
    for i in range(len(before)):
        a, b = before[i], after[i]
        if a == b:
            continue
        sign = 1.0 if b > a else -1.0
        step = sign * threshold
        while (b - level[i] - step) * sign >= 0.0:
            level[i] += step
            share = (level[i] - a) / (b - a)
            share = min(max(share, 0.0), 1.0)  # round-off at the ends
            t[n] = np.int64(start_us + share * (end_us - start_us))
            pixel[n] = i
            p[n] = 1 if sign > 0 else 0
            n += 1
    return n
