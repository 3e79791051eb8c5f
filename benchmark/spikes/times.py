"""Spike times of all pixels, gathered once from a stream's bits."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.spikes.bits import UInt8, in_threads, kernel, rows
from spike4dgs.benchmark.spikes.stream import SpikeStream

_BLOCK = 64  # bytes of a tick, 512 pixels, whose spikes are gathered at a time


@dataclass(frozen=True, eq=False)
class SpikeTimes:
    """The spikes of all pixels, one pixel after the other, in the stored order of pixels."""

    ticks: NDArray[np.int32]  # [N] ascending within a pixel
    starts: NDArray[np.int64]  # [P + 1] pixel p has ticks[starts[p]:starts[p + 1]]


@lru_cache(maxsize=1)
def spike_times(stream: SpikeStream) -> SpikeTimes:
    """Return all spike times of a stream, cached for the last one: images are made stream by stream."""
    packed, pixels = rows(stream.packed), stream.height * stream.width
    starts = np.zeros(pixels + 1, np.int64)
    blocks = -(-packed.shape[1] // _BLOCK)
    in_threads(_count, blocks, packed, starts[1:])
    np.cumsum(starts, out=starts)
    ticks = np.empty(starts[-1], np.int32)
    in_threads(_gather, blocks, packed, starts, ticks)
    return SpikeTimes(ticks, starts)


@kernel
def _count(packed: UInt8, counts: NDArray[np.int64], start: int, stop: int) -> None:
    first, end = start * _BLOCK, min(stop * _BLOCK, packed.shape[1])
    for t in range(len(packed)):
        for byte in range(first, end):
            bits = packed[t, byte]
            for k in range(8):
                if bits >> k & 1 and 8 * byte + k < len(counts):
                    counts[8 * byte + k] += 1


@kernel
def _gather(packed: UInt8, starts: NDArray[np.int64], ticks: NDArray[np.int32], start: int, stop: int) -> None:
    first, end, pixels = start * _BLOCK, min(stop * _BLOCK, packed.shape[1]), len(starts) - 1
    at = starts[8 * first : min(8 * end, pixels)].copy()
    for t in range(len(packed)):
        for byte in range(first, end):
            bits = packed[t, byte]
            for k in range(8):
                p = 8 * (byte - first) + k
                if bits >> k & 1 and p < len(at):
                    ticks[at[p]] = t
                    at[p] += 1
