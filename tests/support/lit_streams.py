"""Spikes of scenes under a light that changes, without noise."""

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack

RATE_HZ = 20_000.0


def lit(
    course: Float64,
    rates: Float64,
    rng: np.random.Generator,
    shares: Float64 | float = 1.0,
    moving: float = 0.0,
    dead: int = 0,
) -> SpikeStream:
    """Return the spikes of mean rates [H, W], of which `shares` follow a light's course [n], in ticks of n.

    A share `moving` of the columns shows a texture that moves, as bright as the rates. Pixels collect no light for
    `dead` ticks after a spike.
    """
    height, width = rates.shape
    texture = rng.uniform(0.05, rates.max(), (height, width + len(course)))
    charge, spikes, rest = rng.uniform(0, 1, rates.shape), [], np.zeros(rates.shape)
    columns = np.arange(width) < moving * width
    for k, factor in enumerate(course):
        light = np.where(columns, texture[:, k // 4 : k // 4 + width], rates) * (1 + shares * (factor - 1))
        charge += np.where(rest > 0, 0, light)
        spikes.append(charge >= 1)
        charge -= spikes[-1]
        rest = np.where(spikes[-1], dead, rest - 1)
    return SpikeStream(pack(np.stack(spikes).astype(np.uint8)), width, height, RATE_HZ, dead_ticks=float(dead))
