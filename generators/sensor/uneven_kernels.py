"""The inner loop of `sensor.model` for a comparator that errs or ripples, and for a pixel that rests after a spike.

It is a plain loop over pixels, about 11 ns for a pixel and tick, 13 times as long as `sensor.kernels` takes; where all
effects are off it gives the same bits. Charge is 64 bits wide, because an early spike leaves a pixel below zero and a
late one above the threshold.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.spikes.bits import kernel
from spike4dgs.benchmark.spikes.sensor_model import fired
from spike4dgs.generators.sensor.kernels import BLOCK, _along, _equal, _prepare, _steady, deviate, mix

READ_SALT = 0x7F4A7C15  # the comparator's random numbers are others than those of the charge
_WAVE = 6 * 3**0.5  # its extremes are then 1 and -1


def wave(ago: Any) -> Any:
    """Return the ripple, in [-1, 1], for a crossing `ago` ticks before its tick ends; a cubic has defined bits."""
    return _WAVE * ago * (1.0 - ago) * (1.0 - 2.0 * ago)


_wave = kernel(wave)


def steady_start(phase: Float64, gathered: Float64, dead: float) -> tuple[Float64, Float64]:
    """Return the charge of pixels in steady light, in thresholds, and how many of their dead ticks are left.

    phase: [H, W] in [0, 1), the share that is over of a pixel's cycle, first its rest and then its gathering;
    gathered: [H, W], the charge of a tick without rest.
    """
    asleep = dead * fired(gathered, dead)  # share of a cycle
    rests = phase < asleep
    left = np.where(rests, dead * (1 - phase / np.where(rests, asleep, 1.0)), 0.0)
    return np.where(rests, 0.0, (phase - asleep) / (1 - asleep)), left


@kernel
def integrate_uneven(
    window: Any,
    ticks: Any,
    tangents: Any,
    radiance_gain: Any,
    gain: Any,
    dark: Any,
    charge: Any,
    unit: Any,
    noise: Any,
    key: Any,
    means: Any,
    read: Any,
    top: Any,
    dead: Any,
    ripple: Any,
    rest: Any,
    words: Any,
    first_block: Any,
    last_block: Any,
) -> None:
    """Fill words[:, first_block:last_block], and advance `charge` and `rest`; see `kernels.integrate`.

    charge [P] int64; `read`: charge units of one step of `deviate` in the comparator, 0 is off; `top`: the threshold in
    charge units; `dead`: ticks after a crossing of the threshold in which a pixel collects nothing; `ripple`: charge
    units; rest [P] float64: how many of the dead ticks are left.
    """
    w = np.empty(6 * BLOCK, np.float32)
    increment = np.empty(BLOCK, np.int32)
    for block in range(first_block, last_block):
        p = block * BLOCK
        g = gain[p : p + BLOCK] if len(gain) > BLOCK else gain
        d = dark[p : p + BLOCK] if len(dark) > BLOCK else dark
        for s in range(len(ticks) - 1):
            n = ticks[s + 1] - ticks[s]
            start = ticks[s] - ticks[0]
            k0, k1 = window[s][p : p + BLOCK], window[s + 1][p : p + BLOCK]
            k2, k3 = window[s + 2][p : p + BLOCK], window[s + 3][p : p + BLOCK]
            constant = means or _equal(k0, k1, k2, k3)
            if constant:
                _steady(k1, g, d, radiance_gain, unit, increment)
            else:
                weights = tangents[s, 0], tangents[s, 1]
                _prepare(k0, k1, k2, k3, weights, g, d, np.float32(radiance_gain), np.float32(unit), n, w)
            for j in range(min(n, len(words) - start)):
                u = (np.float32(j) + np.float32(0.5)) / np.float32(n)
                now = mix(np.uint32(np.uint32(ticks[s] + j) ^ key))
                word = np.uint64(0)
                for i in range(BLOCK):
                    asleep = rest[p + i]
                    if asleep >= 1.0:
                        rest[p + i] = asleep - 1.0
                        continue
                    pixel = np.uint32((p + i) * 0x9E3779B1)
                    x = np.int64(increment[i] if constant else np.int32(_along(w, i, u)))
                    c = charge[p + i] + (np.int64((1.0 - asleep) * x) if asleep > 0.0 else x)
                    asleep = 0.0
                    shown = c + np.int64(read) * deviate(np.uint32(pixel ^ np.uint32(READ_SALT)), now)
                    if shown >= top:
                        word |= np.uint64(1) << np.uint64(i)
                        c -= np.int64(unit) + np.int64(noise) * deviate(pixel, now)
                        if dead > 0.0 or ripple > 0.0:  # from the crossing on, inside the tick
                            ago = min((shown - top) / x, 1.0 - rest[p + i]) if x > 0 else 0.0
                            c += np.int64(ripple * _wave(ago)) - np.int64(min(ago, dead) * x)
                            asleep = max(dead - ago, 0.0)
                        c = min(c, top - 1)  # a full well
                    charge[p + i], rest[p + i] = c, asleep
                words[start + j, block] = word
