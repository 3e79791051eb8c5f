"""Spike times of all pixels, gathered once from a stream's bits.

The intervals that a camera recorded around a few ticks: each pixel's from its last spike before to its first after.

A span holds one or more intervals between spikes. It says how long the pixel took for so many charges, whatever charge
it held when the window began; a count over the window does not know that charge.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Int32, Int64, UInt8
from spike4dgs.benchmark.spikes.bits import in_threads, kernel, rows
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream

_BLOCK = 64  # bytes of a tick, 512 pixels, whose spikes are gathered at a time


@dataclass(frozen=True, eq=False)
class SpikeTimes:
    """The spikes of all pixels, one pixel after the other, in the stored order of pixels."""

    ticks: Int32  # [N] ascending within a pixel
    starts: Int64  # [P + 1] pixel p has ticks[starts[p]:starts[p + 1]]


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
def _count(packed: UInt8, counts: Int64, start: int, stop: int) -> None:
    first, end = start * _BLOCK, min(stop * _BLOCK, packed.shape[1])
    for t in range(len(packed)):
        for byte in range(first, end):
            bits = packed[t, byte]
            for k in range(8):
                if bits >> k & 1 and 8 * byte + k < len(counts):
                    counts[8 * byte + k] += 1


@kernel
def _gather(packed: UInt8, starts: Int64, ticks: Int32, start: int, stop: int) -> None:
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


@dataclass(frozen=True, eq=False)
class Spans:
    """Spans of every pixel [H, W]: ticks of the first and the last spike, and the intervals between them.

    `intervals` is 0 where the recording has no spike before the window or none after it.
    """

    first: Int32
    last: Int32
    intervals: Int32


def is_recorded(stream: SpikeStream, start: int, stop: int) -> bool:
    """Return whether ticks [start, stop) lie within the clip and outside its gaps."""
    inside = 0 <= start < stop <= stream.n_ticks
    return inside and all(gap.stop_tick <= start or gap.first_tick >= stop for gap in stream.gaps)


def spans_around(stream: SpikeStream, start: int, stop: int) -> Spans:
    """Return each pixel's span: from its last spike at or before tick `start` to its first at or after `stop` - 1.

    No span reaches over a gap. The ticks [start, stop), two or more, must be recorded.
    """
    known = present(stream.gaps, stream.n_ticks)
    before, after = np.flatnonzero(~known[:start]), np.flatnonzero(~known[stop:])
    lowest = int(before[-1]) + 1 if len(before) else 0
    highest = stop + int(after[0]) if len(after) else stream.n_ticks
    n = stream.width * stream.height
    first, last, intervals = (np.zeros(n, np.int32) for _ in range(3))
    _find_spans(rows(stream.packed[lowest:highest]), start - lowest, stop - 1 - lowest, first, last, intervals)
    found = [x.reshape(stream.height, stream.width) for x in (first + lowest, last + lowest, intervals)]
    return Spans(*(x[::-1] if stream.rows_bottom_up else x for x in found))


@kernel
def _find_spans(packed: Any, start: Any, stop: Any, first: Any, last: Any, intervals: Any) -> None:
    """Fill the spans of all pixels [P], from packed rows [T, bytes]; intervals stay 0 where an end is missing."""
    for pixel in range(len(first)):
        byte, bit = pixel >> 3, np.uint8(1 << (pixel & 7))
        a = start
        while a >= 0 and not packed[a, byte] & bit:
            a -= 1
        if a < 0:
            continue
        b, count = a, 0
        for tick in range(a + 1, len(packed)):
            if packed[tick, byte] & bit:
                b, count = tick, count + 1
                if tick >= stop:
                    break
        if count > 0 and b >= stop:
            first[pixel], last[pixel], intervals[pixel] = a, b, count
