"""Spikes of a camera with another clock, another gain or bad pixels, from the spikes of a perfect one.

Between two spikes a pixel gathers one threshold of charge, here at an even rate: its charge q(t) is piecewise linear,
and whole where it fires. A camera of gain g fires where g q(t) is whole, and notes the tick that its own clock shows.
Where in its tick a spike fell is not known; each pixel takes one random place, so that a shift by a part of a tick
moves that part of the pixels. Light before the first and after the last spike is as even as the silence allows.

At most one spike a tick: a second one waits for the next tick, a third is lost (the well is full).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64, UInt8
from spike4dgs.benchmark.scene.camera_state import Clock
from spike4dgs.benchmark.spikes.bits import kernel
from spike4dgs.benchmark.spikes.sensor_model import charge_after_spike
from spike4dgs.generators.recorder.emulation.imperfections import BadPixels, Pixels, WorseCamera, random

DWELL_TICKS = 100.0  # mean time that a flickering pixel stays in one of its two states: 5 ms at 20 kHz
_MARGIN = 1e-6  # ticks
_BLOCK = 512  # bytes of a tick, of 8 pixels each, unpacked at a time


def worse_stream(packed: UInt8, width: int, height: int, camera: WorseCamera, seed: int, name: str, mode: str) -> UInt8:
    """Return packed ticks [n, bytes], rows bottom-up, as a camera of these imperfections sends them.

    `mode` is what is recorded: a flickering pixel flickers anew in each recording. Dropped ticks are still there.
    """
    out = packed
    if (camera.clock, camera.gain) != (Clock(), 1.0):
        places = random(seed, name, "place of spikes in their tick").uniform(0.01, 0.99, width * height)
        out = retimed(packed, places, camera.gain, camera.clock)
    if len(camera.bad.dead) or len(camera.bad.hot) or len(camera.bad.flickering):
        out = _with_bad_pixels(out, width, height, camera.bad, random(seed, name, f"flickering {mode}"))
    return out


def retimed(packed: UInt8, places: Float64, gain: float, clock: Clock) -> UInt8:
    """Return packed ticks [n, bytes] of a camera of another gain and clock. `places` [pixels], in stored order."""
    out = np.zeros(packed.shape, np.uint8)
    rate = 1 + clock.drift_ppm * 1e-6
    for first in range(0, packed.shape[1], _BLOCK):
        columns = slice(first, first + _BLOCK)
        fired = np.unpackbits(packed[:, columns], axis=1, bitorder="little").T.copy()  # [pixels, T]
        own = places[8 * first : 8 * first + len(fired)]
        spikes = np.zeros(fired.shape, np.uint8)
        _retime(fired[: len(own)], own, gain, clock.offset_ticks, rate, spikes)
        out[:, columns] = np.packbits(spikes.T, axis=1, bitorder="little")
    return out


@kernel
def _retime(fired: UInt8, places: Float64, gain: float, offset: float, rate: float, out: UInt8) -> None:
    n_ticks = fired.shape[1]
    times = np.empty(n_ticks, np.float64)
    for p in range(len(fired)):
        n = 0
        for t in range(n_ticks):
            if fired[p, t]:
                times[n] = t + places[p]
                n += 1
        if n == 0:
            continue
        # Ticks of a threshold before the first spike and after the last: no spike was seen there.
        before = max(times[1] - times[0], times[0] + _MARGIN) if n > 1 else float(n_ticks)
        after = max(times[n - 1] - times[n - 2], n_ticks - times[n - 1]) if n > 1 else float(n_ticks)
        begin = -offset / rate  # the array's time at the camera's tick 0
        level = np.floor(gain * min(1 + (begin - times[0]) / before, 1.0))  # not above the charge at the beginning
        last = -1
        while True:
            level += 1
            charge = level / gain
            if charge <= 1:
                t = times[0] + (charge - 1) * before
            elif charge >= n:
                t = times[n - 1] + (charge - n) * after
            else:
                i = int(charge)
                t = times[i - 1] + (charge - i) * (times[i] - times[i - 1])
            tick = int(np.floor(offset + rate * t))
            chosen = max(tick, last + 1)
            if chosen >= n_ticks:
                break
            if tick >= 0 and chosen <= tick + 1:
                out[p, chosen] = 1
                last = chosen


def _with_bad_pixels(packed: UInt8, width: int, height: int, bad: BadPixels, rng: np.random.Generator) -> UInt8:
    out = packed.copy()
    _put(out, _stored(bad.dead, width, height), np.zeros((len(packed), len(bad.dead)), np.uint8))
    noisy = _stored(np.concatenate([bad.hot, bad.flickering]), width, height)
    current = np.tile(bad.current, (len(packed), 1))
    current[:, len(bad.hot) :] *= telegraph(len(packed), len(bad.flickering), rng)
    _put(out, noisy, with_current(_get(packed, noisy), current))
    return out


def telegraph(n_ticks: int, pixels: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return states [n_ticks, pixels] that change at random, after DWELL_TICKS on average."""
    changes = rng.random((n_ticks, pixels)) < 1 / DWELL_TICKS
    changes[0] = rng.random(pixels) < 0.5
    return np.asarray(np.cumsum(changes, axis=0) % 2 == 1)


def with_current(spikes: UInt8, current: Float64) -> UInt8:
    """Return spikes [T, P] of pixels that gather `current` [T, P] per tick beside the charge of their own spikes."""
    n_ticks, edges = len(spikes), np.arange(len(spikes) + 1)
    out = np.zeros(spikes.shape, np.uint8)
    for p in range(spikes.shape[1]):
        times = np.nonzero(spikes[:, p])[0] + 1  # the ends of their ticks
        knots = np.concatenate([[0], times, [n_ticks + 1]])
        charge = np.interp(edges, knots, np.append(np.arange(len(times) + 1), len(times)))
        level = 0.0
        for t, gathered in enumerate(np.diff(charge) + current[:, p]):
            level += gathered
            if level >= 1:
                out[t, p], level = 1, charge_after_spike(level, 1.0)
    return out


def _stored(pixels: Pixels, width: int, height: int) -> Pixels:
    """Return the places of upright pixels in a tick whose rows are bottom-up."""
    return np.asarray((height - 1 - pixels // width) * width + pixels % width)


def _get(packed: UInt8, stored: Pixels) -> UInt8:
    return np.asarray(packed[:, stored >> 3] >> (stored & 7).astype(np.uint8) & 1)


def _put(packed: UInt8, stored: Pixels, spikes: UInt8) -> None:
    for p, own in zip(stored, spikes.T, strict=True):  # two pixels may share a byte
        byte, bit = p >> 3, np.uint8(p & 7)
        packed[:, byte] = packed[:, byte] & ~(np.uint8(1) << bit) | own << bit
