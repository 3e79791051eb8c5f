"""Spikes made on the fly from a burst's images: a window of the simulated cameras.

The model is that of `benchmark.spikes.sensor_model`; a pixel's charge before the window is uniform. Charge is float64
here, and radiance is linear between the images, which lie at tick boundaries, so that no tick spans two pieces. The
scenes' simulator (`generators.sensor`: integer charge, cubic curve between key frames) is the exact twin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.training_bursts import REACH, Float32
from spike4dgs.benchmark.spikes.bits import kernel
from spike4dgs.benchmark.spikes.sensor_model import SENSOR, charge_after_spike, charge_of_tick

_DEVIATES = 1 << 16  # normal numbers drawn for a window; each pixel starts somewhere else among them
_charge_of_tick = kernel(charge_of_tick)
_charge_after_spike = kernel(charge_after_spike)


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels of some cameras and the light on them: arrays over pixels, in any shape after the first axis of `rates`.

    Attributes:
        rates: [k, ...] spikes per tick that the light asks for, at k instants evenly from -REACH to REACH ticks.
        gain: [...] relative sensitivity.
        dark: [...] spikes per tick in the dark.
        photons: number of photons per spike, for shot noise; infinity means none.
    """

    rates: Float32
    gain: Float32
    dark: Float32
    photons: float


def make_spikes(pixels: Pixels, ticks: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return spikes [ticks, ...] of 0 and 1; the instant is the start of the middle tick, number ticks // 2.

    `ticks` is odd.
    """
    return fire(pixels, ticks, rng.random(pixels.gain.shape, np.float32), rng)


def fire(pixels: Pixels, ticks: int, charge: Float32, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the spikes for given charges [...] in [0, 1) before the window; only the shot noise is drawn."""
    sd, cutoff = pixels.photons**-0.5, SENSOR.noise_cutoff
    deviates = np.clip(rng.standard_normal(_DEVIATES, np.float32), -cutoff, cutoff) * np.float32(sd)
    starts = rng.integers(0, _DEVIATES, charge.size, np.uint16)
    spikes = np.empty((ticks, charge.size), np.uint8)
    rates = np.ascontiguousarray(pixels.rates.reshape(len(pixels.rates), -1))
    gain, dark, charge_before = (np.ascontiguousarray(a).ravel() for a in (pixels.gain, pixels.dark, charge))
    first = REACH - ticks // 2
    _integrate(rates, gain, dark, charge_before, deviates, starts, 1 + cutoff * sd, first, spikes)
    return spikes.reshape(ticks, *charge.shape)


@kernel
def _integrate(
    rates: Any, gain: Any, dark: Any, charge: Any, deviates: Any, starts: Any, most: float, first: int, spikes: Any
) -> None:
    """Fill spikes [T, N] of ticks first, first + 1, ... after the first of the images rates [k, N]."""
    count, n = rates.shape
    spacing = 2 * REACH // (count - 1)
    for p in range(n):
        level, number = np.float64(charge[p]), int(starts[p])
        for t in range(len(spikes)):
            piece = (first + t) // spacing
            u = (first + t + 0.5 - piece * spacing) / spacing
            rate = (1 - u) * rates[piece, p] + u * rates[piece + 1, p]
            level += _charge_of_tick(gain[p] * rate, dark[p], most)
            fired = level >= 1.0
            if fired:
                level = _charge_after_spike(level, 1.0 + deviates[number])
                number = (number + 1) % _DEVIATES
            spikes[t, p] = fired
