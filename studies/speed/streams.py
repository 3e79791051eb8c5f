"""Simulated streams to time on."""

from __future__ import annotations

import numpy as np

from spike4dgs.benchmark.spikes.stream import SpikeStream, pack


def fired_stream(ticks: int, width: int, height: int, seed: int = 0) -> SpikeStream:
    """Return a stream of ideal integrate-and-fire pixels with rates of 0.01 to 0.6 spikes per tick, fixed in time."""
    rng = np.random.default_rng(seed)
    rate, charge = rng.uniform(0.01, 0.6, (height, width)), rng.random((height, width))
    packed = []
    for _ in range(ticks):
        charge += rate
        fired = charge >= 1
        charge -= fired
        packed.append(pack(fired[None]))
    return SpikeStream(np.concatenate(packed), width, height, 20_000.0)
