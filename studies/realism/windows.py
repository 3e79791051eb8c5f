"""Windows of recordings, simulated counterparts of equal rates, and what is measured of each window.

A still pixel's counterpart takes its rate from the other half of the recording, drawn from all rates that steady light
explains: (intervals k - 1) / k < 1 / rate < (k + 1) / k of every span of k intervals. A rate (spikes - 1) / ticks would
be exactly 1 / n far too often, as a pixel near it shows no other interval in half a recording. A moving pixel's course
is that of `adaptive`, from the same ticks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from spike4dgs.benchmark.arrays import Float32, Float64, Int64, Mask, UInt8
from spike4dgs.benchmark.scene.calibration import rates
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate
from spike4dgs.method.images.adaptive import adaptive_image

SIDE, TICKS = 8, 100  # of a window
RATE_HZ = 20_000.0  # of streams in memory; nothing here depends on it
RUN_UP = 60  # ticks before a simulated recording
KEY_TICKS = 10  # between keys of a moving pixel's course
STILL = 0.010  # most relative change of smoothed quarters; their own noise gives 0.005
MOVING = 0.04
_BUSY = 0.1  # share of a row that moves
_SMOOTH_PX = 4.0
_RATES = (0.05, 0.95)  # spikes per tick: enough spikes, not saturated
SPANS, COUNTS = (2, 4, 8), (5, 10, 20)  # intervals, ticks


def changes(spikes: UInt8) -> tuple[Float64, Float64]:
    """Return the mean rate [H, W] of spikes [T, H, W], and the relative range of their quarters' smoothed rates."""
    quarters = [gaussian_filter(part.mean(0), _SMOOTH_PX) for part in np.array_split(spikes, 4)]
    rate = np.asarray(spikes.mean(0))
    return rate, np.ptp(quarters, axis=0) / np.maximum(np.mean(quarters, axis=0), 1e-6)


def corners_of(pixels: Mask, share: float = 0.9) -> Int64:
    """Return the corners (y, x) [N, 2] of the squares of a grid in which at least `share` of the pixels are chosen."""
    h, w = (n // SIDE * SIDE for n in pixels.shape)
    full = pixels[:h, :w].reshape(h // SIDE, SIDE, w // SIDE, SIDE).mean((1, 3)) >= share
    return np.argwhere(full) * SIDE


def regions_of(spikes: UInt8) -> dict[str, Mask]:
    """Return the pixels [H, W] of a recording that are compared, by what they see.

    `still`: steady light, in rows in which nothing moves; `beside motion`: steady light in other rows, which share
    their readout with what moves; `moving`. All at rates at which windows have enough spikes and are not saturated, and
    off the chip's edges, whose rows may be copies of others.
    """
    rate, change = changes(spikes)
    usable = (rate > _RATES[0]) & (rate < _RATES[1])
    usable[:SIDE] = usable[-SIDE:] = usable[:, :SIDE] = usable[:, -SIDE:] = False
    busy = (change > MOVING).mean(1, keepdims=True) > _BUSY
    still = usable & (change < STILL)
    return {"still": still & ~busy, "beside motion": still & busy, "moving": usable & (change > MOVING)}


def stream_of(spikes: UInt8) -> SpikeStream:
    """Return unpacked spikes [T, H, W] as a stream in memory."""
    return SpikeStream(pack(spikes), spikes.shape[2], spikes.shape[1], RATE_HZ)


def drawn_rates(spikes: UInt8, ripple: float, rng: np.random.Generator) -> Float32:
    """Return rates [H, W], each drawn about the middle of those with which steady light explains a pixel's spikes.

    A pixel that none explains, of few spikes or changing light, keeps (spikes - 1) / ticks between first and last. With
    a clock ripple these are the rates without it, see `without_ripple`.
    """
    pixel, tick = np.nonzero(spikes.reshape(len(spikes), -1).T)
    n_pixels = spikes[0].size
    low, high = np.zeros(n_pixels), np.full(n_pixels, np.inf)
    short, long = np.full(n_pixels, np.inf), np.zeros(n_pixels)
    for k in range(1, int(np.bincount(pixel, minlength=1).max(initial=0))):
        same = pixel[k:] == pixel[:-k]
        span, own = (tick[k:] - tick[:-k])[same], pixel[k:][same]
        np.maximum.at(low, own, (span - 1) / k)
        np.minimum.at(high, own, (span + 1) / k)
        if k == 1:
            np.minimum.at(short, own, span)
            np.maximum.at(long, own, span)
    plain = rates(stream_of(spikes)).ravel()
    explained = (low > 0) & (low < high) & np.isfinite(high)
    share = rng.triangular(0, 0.5, 1, n_pixels)
    interval = np.where(explained, low + np.where(explained, high - low, 0) * share, 1 / plain)
    interval = without_ripple(interval, short == long, ripple, rng)
    return np.asarray(1 / interval, np.float32).reshape(spikes.shape[1:])


def without_ripple(interval: Float64, locked: Mask, ripple: float, rng: np.random.Generator) -> Float64:
    """Return the mean intervals [N] that pixels would have without a clock ripple.

    Within w = ripple * n of n ticks a pixel locks: any of these is as likely. Outside, what would be d from n is
    sqrt(d^2 - w^2) from it, as in any map of a circle with a push that is a sine (Adler 1946).
    """
    whole = np.rint(interval)
    width, off = ripple * whole, interval - whole
    outside = np.copysign(np.hypot(off, width), off)
    return np.asarray(whole + np.where(locked, off + width * rng.uniform(-1, 1, len(interval)), outside))


def course(spikes: UInt8) -> tuple[Float32, Int64]:
    """Return rates [K, H, W] of changing light by `adaptive`, and their ticks."""
    stream, ticks = stream_of(spikes), np.arange(0, len(spikes) + 1, KEY_TICKS)
    return np.stack([adaptive_image(stream, min(int(t), len(spikes) - 1)) for t in ticks]), ticks


def record(keys: Sequence[Float32] | Float32, ticks: Sequence[int] | Int64, sensor: Sensor, seed: int) -> UInt8:
    """Return the spikes [T, H, W] that a sensor of radiance gain 1 and uniform pixels records of rates at `ticks`.

    The first rate lasts RUN_UP ticks before: phases of pixels that lock are not uniform.
    """
    n, (height, width) = int(ticks[-1]) + RUN_UP, keys[0].shape
    held = [0, *(int(t) + RUN_UP for t in ticks)]
    noisy = replace(sensor, noise_seed=(*sensor.noise_seed, seed))
    packed = [*simulate([keys[0], *keys], held, n, noisy, random_charge(height, width, [seed]))]
    return SpikeStream(np.concatenate(packed), width, height, RATE_HZ).window(RUN_UP, n)


def halves(spikes: UInt8) -> list[UInt8]:
    """Return the first and the second TICKS of a recording."""
    return [spikes[:TICKS], spikes[TICKS : 2 * TICKS]]


def counterpart(spikes: UInt8, sensor: Sensor, seed: int) -> list[UInt8]:
    """Return simulated halves, each at the steady rates of the other half of the recording."""
    rng = np.random.default_rng(seed)
    drawn = [drawn_rates(half, sensor.clock_ripple, rng) for half in halves(spikes)][::-1]
    return [record([rate, rate], [0, TICKS], sensor, seed + i) for i, rate in enumerate(drawn)]


def moving_counterpart(spikes: UInt8, sensor: Sensor, seed: int) -> list[UInt8]:
    """Return simulated halves at the course of the recording's light."""
    return halves(record(*course(spikes[: 2 * TICKS]), sensor, seed))


def table(parts: Sequence[UInt8], corners: Int64) -> tuple[tuple[str, ...], Float64]:
    """Return names of features, and their values [parts * N, F] of the window at each corner of each part."""
    rows = [features(part[:, y : y + SIDE, x : x + SIDE]) for part in parts for y, x in corners]
    return tuple(rows[0]), np.array([[*row.values()] for row in rows])


def _spread(spans: Int64, own: Int64, pixels: int, least: int) -> float:
    """Return the mean over pixels with `least` values of their variance, less f (1 - f) of two neighbouring lengths."""
    n = np.bincount(own, minlength=pixels)
    mean = np.bincount(own, spans, pixels) / np.maximum(n, 1)
    variance = np.bincount(own, spans**2, pixels) / np.maximum(n, 1) - mean**2 - (mean % 1) * (1 - mean % 1)
    return float(variance[n >= least].mean()) if (n >= least).any() else 0.0


def features(window: NDArray[np.generic]) -> dict[str, float]:
    """Return what is measured of a window [T, H, W]; the unit is a tick, or what independent pixels have."""
    n_ticks, height, width = window.shape
    spikes = window.reshape(n_ticks, -1).astype(np.float64)
    pixels = spikes.shape[1]
    pixel, tick = np.nonzero(spikes.T)
    same = pixel[1:] == pixel[:-1]
    interval, own = np.diff(tick)[same], pixel[1:][same]
    n = np.bincount(own, minlength=pixels)
    enough = n >= 3
    mean = np.bincount(own, interval, pixels) / np.maximum(n, 1)
    short, long = np.full(pixels, n_ticks), np.zeros(pixels, np.int64)
    np.minimum.at(short, own, interval)
    np.maximum.at(long, own, interval)
    off = interval - mean[own]
    next_ = own[1:] == own[:-1]
    found = {
        "one interval": float((long == short)[enough].mean()) if enough.any() else 0.0,
        "intervals two apart": float((long > short + 1)[enough].mean()) if enough.any() else 0.0,
        "shortest interval": float((short - np.floor(mean))[enough].mean()) if enough.any() else 0.0,
        "longest interval": float((long - np.ceil(mean))[enough].mean()) if enough.any() else 0.0,
        "even intervals": float((interval % 2 == 0).mean()) if len(interval) else 0.0,
        "next interval": float((off[1:] * off[:-1])[next_].mean() / max((off**2).mean(), 1e-9)) if next_.any() else 0.0,
        "variance of 1 interval": _spread(interval, own, pixels, 3),
    }
    for k in SPANS:
        apart = pixel[k:] == pixel[:-k]
        found[f"variance of {k} intervals"] = _spread((tick[k:] - tick[:-k])[apart], pixel[k:][apart], pixels, 3)
    for ticks in COUNTS:
        counts = spikes[: n_ticks // ticks * ticks].reshape(-1, ticks, pixels).sum(1)
        part = counts.mean(0) % 1
        found[f"variance of counts of {ticks} ticks"] = float((counts.var(0, ddof=1) - part * (1 - part)).mean())
    rate = spikes.mean(0)
    image, d = rate.reshape(height, width), (spikes - rate).reshape(window.shape)
    unit = max(float((d**2).mean()), 1e-9)
    alternating = np.tensordot((-1.0) ** np.arange(n_ticks), d, 1)
    half = n_ticks // 2
    found |= {
        "pixel to the right": float((d[:, :, 1:] * d[:, :, :-1]).mean()) / unit,
        "pixel below": float((d[:, 1:] * d[:, :-1]).mean()) / unit,
        "pixel to the right, a tick later": float((d[1:, :, 1:] * d[:-1, :, :-1]).mean()) / unit,
        "pixel below, a tick later": float((d[1:, 1:] * d[:-1, :-1]).mean()) / unit,
        "rows": float((d.mean(2) ** 2).mean()) * width / unit,
        "columns": float((d.mean(1) ** 2).mean()) * height / unit,
        "all pixels": float((d.mean((1, 2)) ** 2).mean()) * pixels / unit,
        "odd ticks, pixel by pixel": float((alternating**2).mean()) / n_ticks / unit,
        "odd ticks, all pixels": float(alternating.mean() ** 2) * pixels / n_ticks / unit,
        "roughness across": float(np.log((np.diff(image, axis=1) ** 2).mean() + 1e-9)),
        "roughness down": float(np.log((np.diff(image, axis=0) ** 2).mean() + 1e-9)),
        "rate": float(rate.mean()),
        "change of rate": abs(float(spikes[:half].mean() - spikes[half:].mean())),
        "first spike": float((np.argmax(spikes > 0, axis=0) * rate).mean()),
    }
    return found
