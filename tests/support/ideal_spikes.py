"""Spikes of ideal pixels under light that is known exactly: no noise, any rates."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64, Mask

Gathered = Callable[[Float64, NDArray[np.int64], NDArray[np.int64]], Float64]


def fire(rates: Float64, charge: Float64) -> Mask:
    """Spikes [T, H, W] of an ideal pixel: rates [T, H, W] in spikes per tick, charges [H, W] at the start."""
    total = charge + np.cumsum(rates, axis=0)
    return np.diff(np.floor(total), axis=0, prepend=np.floor(charge)[None]) > 0


def sweeping(n: int, height: int, width: int, px_per_tick: float, seed: int = 0) -> Float64:
    """Rates [n, H, W] of a smooth texture that moves to the right, between 0.1 and 0.9 spikes per tick."""
    rng = np.random.default_rng(seed)
    waves = rng.uniform(0.05, 0.25, (4, 2)), rng.uniform(0, 2 * np.pi, 4)
    t, y, x = np.mgrid[:n, :height, :width]
    u = x - px_per_tick * (t + 0.5)
    total = sum(np.sin(2 * np.pi * (a * u + b * y) + p) for (a, b), p in zip(*waves, strict=True))
    return np.asarray(0.5 + 0.1 * total)


def gathered(rates: Float64) -> Gathered:
    """Return a function of instants in ticks, rows and columns: the light that those pixels gathered by then."""
    before = np.concatenate([np.zeros((1, *rates.shape[1:])), np.cumsum(rates, axis=0)])  # by the start of each tick

    def by(t: Float64, y: NDArray[np.int64], x: NDArray[np.int64]) -> Float64:
        k = np.floor(t).astype(int)
        return np.asarray(before[k, y, x] + (t - k) * rates[k, y, x])

    return by
