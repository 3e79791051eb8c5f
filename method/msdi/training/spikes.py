"""Spikes made on the fly from a burst's images: the sensor of the simulated cameras, for a window of ticks.

In every tick a pixel gains gain * (spikes per tick that its radiance asks for) + dark, in thresholds, at most what a
spike can take; at charge 1 it fires and loses 1 + g / sqrt(photons), g standard normal; what is left is kept. A pixel's
charge before the window is uniform. The scenes' simulator (integer charge, cubic curve between images) is the exact
twin; here charge is float64 and radiance linear between images, in which no tick spans two pieces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.bursts import REACH, Float32
from spike4dgs.benchmark.spikes.bits import kernel

_DEVIATES = 1 << 16  # normal numbers drawn for a window; each pixel starts somewhere else among them
_MOST_SD = 3.46  # the noise is cut off there
_FULL = 1 - 2.0**-31  # thresholds: the most that is left after a spike


@dataclass(frozen=True, eq=False)
class Pixels:
    """What the sensors of some cameras see and are: arrays over pixels, in any shape after the first axis of `rates`.

    Attributes:
        rates: [k, ...] spikes per tick that the light asks for, at k instants evenly from -REACH to REACH ticks.
        gain: [...] relative sensitivity.
        dark: [...] spikes per tick in the dark.
        photons: to a spike, for shot noise; infinity is none.
    """

    rates: Float32
    gain: Float32
    dark: Float32
    photons: float


def make_spikes(pixels: Pixels, ticks: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Spikes [ticks, ...] of 0 and 1, `ticks` odd; the instant is the start of the middle tick, number ticks // 2."""
    return fire(pixels, ticks, rng.random(pixels.gain.shape, np.float32), rng)


def fire(pixels: Pixels, ticks: int, charge: Float32, rng: np.random.Generator) -> NDArray[np.uint8]:
    """`make_spikes` from charges [...] in [0, 1) before the window; only the shot noise is drawn."""
    sd = pixels.photons**-0.5
    deviates = np.clip(rng.standard_normal(_DEVIATES, np.float32), -_MOST_SD, _MOST_SD) * np.float32(sd)
    starts = rng.integers(0, _DEVIATES, charge.size, np.uint16)
    spikes = np.empty((ticks, charge.size), np.uint8)
    rates = np.ascontiguousarray(pixels.rates.reshape(len(pixels.rates), -1))
    gain, dark, charge_before = (np.ascontiguousarray(a).ravel() for a in (pixels.gain, pixels.dark, charge))
    first = REACH - ticks // 2
    _integrate(rates, gain, dark, charge_before, deviates, starts, 1 + _MOST_SD * sd, first, spikes)
    return spikes.reshape(ticks, *charge.shape)


@kernel
def _integrate(
    rates: Any, gain: Any, dark: Any, charge: Any, deviates: Any, starts: Any, most: float, first: int, spikes: Any
) -> None:
    """Fill spikes [T, N] of ticks first, first + 1, ... after the first of the images rates [k, N]."""
    count, n = rates.shape
    spacing = 2 * REACH // (count - 1)
    for p in range(n):
        level, place = np.float64(charge[p]), int(starts[p])
        for t in range(len(spikes)):
            piece = (first + t) // spacing
            u = (first + t + 0.5 - piece * spacing) / spacing
            rate = (1 - u) * rates[piece, p] + u * rates[piece + 1, p]
            level += min(max(gain[p] * rate + dark[p], 0.0), most)
            fired = level >= 1.0
            if fired:
                level = min(level - (1.0 + deviates[place]), _FULL)
                place = (place + 1) % _DEVIATES
            spikes[t, p] = fired
