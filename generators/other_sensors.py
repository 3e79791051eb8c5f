"""Other sensors that film the same scene: a conventional camera of 60 fps, and an event camera.

A frame is the mean radiance over its exposure (real blur). The mean is exact for the simulator's curve between keys
(see `sensor.model`) up to its clamp: the integral of its cubic, also where an exposure begins or ends inside an
interval.

Events follow the contrast-threshold model (as in ESIM, Rebecq et al. 2018). Each pixel stores the log radiance of its
last event, at first that of the first key. Whenever the log radiance is a whole threshold away, the pixel fires a
positive or negative event. Between keys log radiance is linear in time; times are microseconds, rounded down.

Both are free of noise unless they are given some: `FrameNoise`, `EventNoise`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.scene.other_sensors import Events
from spike4dgs.benchmark.spikes.bits import kernel

FPS = 60
EXPOSURE_S = 1 / 120  # a shutter of 180 degrees


@dataclass(frozen=True)
class FrameNoise:
    """Noise of a frame, of Sony's Pregius sensors with pixels of 3.45 um (IMX250, IMX255).

    Teledyne DALSA's Genie Nano manual has a full well of 10.7 ke- for the IMX250. MATRIX VISION's mvBlueFOX3 manual has
    a signal-to-noise ratio of 40.3 dB for the IMX255, which is the shot noise of 10.7 ke- too, and a dynamic range of
    71.3 dB: a noise in the dark of 10,700 / 10^(71.3 / 20) = 2.9 e-. White fills the well: no exposure has less noise.
    """

    full_well: float = 10_700.0  # electrons at radiance 1
    read: float = 2.9  # electrons, standard deviation


def noisy_frame(radiance: Float32, noise: FrameNoise, rng: np.random.Generator) -> Float32:
    """Return a frame [H, W] with shot noise and read noise, between black and a full well."""
    electrons = rng.poisson(np.maximum(radiance, 0) * noise.full_well) + rng.normal(0, noise.read, radiance.shape)
    return (np.clip(electrons, 0, noise.full_well) / noise.full_well).astype(np.float32)


def exposures(
    keys: Sequence[Float32], key_ticks: Sequence[int], n_ticks: int, rate_hz: int, means: bool = False
) -> Iterator[tuple[int, Float32]]:
    """Yield (tick at which the exposure begins, mean radiance [H, W]) of each frame whose exposure fits into the clip.

    `keys` are read in ascending order, each exposure's keys once; with `means` there is one for each tick, the mean
    over it. A clip shorter than one exposure has no frame.
    """
    length = round(EXPOSURE_S * rate_hz)
    frame = 0
    while (start := round(frame * rate_hz / FPS)) + length <= n_ticks:
        yield start, (_mean_of if means else _mean)(keys, key_ticks, start, start + length)
        frame += 1


def _mean_of(means: Sequence[Float32], ticks: Sequence[int], start: int, end: int) -> Float32:
    total = np.zeros(np.shape(means[start]))
    for tick in ticks[start:end]:
        total += means[tick]
    return (total / (end - start)).astype(np.float32)


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


@dataclass(frozen=True)
class EventNoise:
    """Noise of an event camera, by the model and with the numbers of v2e (Hu, Liu, Delbruck, CVPR Workshops 2021).

    Mismatch and rate are those of its preset `noisy`, made for dim light; the refractory period is its default.
    Of the preset's further noise, leak events of 0.1 Hz and a bandwidth of 30 Hz are left out.
    """

    mismatch: float = 0.05  # standard deviation of a pixel's thresholds, of log radiance
    shot_hz: float = 5.0  # events of a black pixel a second, half of them positive; they change no stored radiance
    shot_bright: float = 0.25  # of that at white
    refractory_us: float = 500.0  # after a change's event: no others, and what changes is told later; shot events come


_LEAST_THRESHOLD = 0.01  # as in v2e


def events(
    keys: Sequence[Float32],
    key_ticks: Sequence[int],
    n_ticks: int,
    rate_hz: int,
    threshold: float = THRESHOLD,
    noise: EventNoise | None = None,
    rng: np.random.Generator | None = None,
) -> Events:
    """Return the events of a clip from radiance keys [H, W], read one at a time, up to tick `n_ticks`.

    `rng` draws the noise, if there is any.
    """
    before = _log(keys[0])
    level = before.astype(np.float64)
    height, width = before.shape
    thresholds, refractory_us = np.full((2, before.size), threshold), 0.0
    if noise and rng:
        thresholds = np.maximum(rng.normal(threshold, noise.mismatch, thresholds.shape), _LEAST_THRESHOLD)
        refractory_us = noise.refractory_us
    last_us, least = np.full(before.size, -np.inf), thresholds.min(axis=0).reshape(before.shape)
    found = []
    for k in range(1, len(key_ticks)):
        if key_ticks[k - 1] >= n_ticks:
            break
        after = _log(keys[k])
        span_us = np.array([key_ticks[k - 1], key_ticks[k]]) * 1e6 / rate_hz
        # up to where the light was, for an event that waits, then on to where it goes: they may be opposite ways
        room = int(np.ceil((np.abs(before - level) + np.abs(after - before)) / least).sum()) + 1
        t, pixel, p = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.uint8)
        lines, last = (before.ravel(), after.ravel(), level.ravel()), (last_us, refractory_us)
        n = crossings(*lines, span_us[0], span_us[1], thresholds, *last, t, pixel, p)
        parts = [(t[:n], pixel[:n], p[:n])]
        if noise and rng:
            parts.append(_shot_events(before, span_us, noise, rng))
        t, pixel, p = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        order = np.lexsort((pixel, t))
        found.append((t[order], pixel[order], p[order]))
        before = after
    t, pixel, p = (np.concatenate([f[i] for f in found]) for i in range(3))
    inside = t < n_ticks * 1e6 / rate_hz
    y, x = np.divmod(pixel[inside], width)
    return Events(t[inside], x.astype(np.uint16), y.astype(np.uint16), p[inside])


def _shot_events(
    log: NDArray[np.float64], span_us: NDArray[np.float64], noise: EventNoise, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint8]]:
    """Return times, pixels and polarities of the shot events of an interval, at random times."""
    bright = np.clip(np.exp(log.ravel()), 0, 1)
    rate = noise.shot_hz * (1 - (1 - noise.shot_bright) * bright)
    counts = rng.poisson(rate * (span_us[1] - span_us[0]) * 1e-6)
    pixel = np.repeat(np.arange(log.size), counts)
    t = rng.uniform(span_us[0], span_us[1], len(pixel)).astype(np.int64)
    return t, pixel, rng.integers(0, 2, len(pixel), dtype=np.uint8)


def _log(image: Float32) -> NDArray[np.float64]:
    return np.log(np.maximum(np.asarray(image, dtype=np.float64), _DARKEST))


@kernel
def crossings(
    before: Any,
    after: Any,
    level: Any,
    start_us: Any,
    end_us: Any,
    thresholds: Any,
    last_us: Any,
    refractory_us: Any,
    t: Any,
    pixel: Any,
    p: Any,
) -> int:
    """Fill t, pixel and p with the events of one interval, pixel by pixel; advance the state; return their number.

    before, after: log radiance [P] at the start and at the end. State: `level`, the log radiance that the events have
    told, and `last_us`, the time of the last event [P]. thresholds: [2, P], of darker and of brighter.
    A pixel that is still a threshold away when its refractory period ends sends an event at once.
    """
    n = 0
    for i in range(len(before)):
        a, b = before[i], after[i]
        free = max(start_us, last_us[i] + refractory_us)
        while free < end_us or (refractory_us == 0.0 and free <= end_us):
            at = a + (b - a) * ((free - start_us) / (end_us - start_us))
            if refractory_us > 0.0 and at - level[i] >= thresholds[1, i]:  # it has waited for the pixel
                brighter, now = True, free
            elif refractory_us > 0.0 and level[i] - at >= thresholds[0, i]:
                brighter, now = False, free
            else:
                if a == b:
                    break
                brighter = b > a
                sign = 1.0 if brighter else -1.0
                step = sign * thresholds[1 if brighter else 0, i]
                if (b - level[i] - step) * sign < 0.0:
                    break
                share = min(max((level[i] + step - a) / (b - a), 0.0), 1.0)  # round-off at the ends
                now = max(start_us + share * (end_us - start_us), free)
            level[i] += thresholds[1, i] if brighter else -thresholds[0, i]
            last_us[i] = now
            t[n], pixel[n], p[n] = np.int64(now), i, 1 if brighter else 0
            n += 1
            free = now + refractory_us
    return n
