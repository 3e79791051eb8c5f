"""Spike trains: the bits of a stream, turned so that a pixel's ticks lie in words, and counted now and then.

Where a pixel's spikes are, and how many of them come before a tick, is then found in a few operations, however long the
clip is. Certain spikes are here, and apart from them what lost ticks were filled with in doubt (`lost_spikes`). Trains
take 1.13 times the stream's bytes, whatever its spikes; a list of their ticks takes 32 bits for each.

The kernels below are for other kernels, on the stored order of pixels. Words of one tick lie next to each other: images
look at all pixels around the same few ticks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from spike4dgs.benchmark.arrays import Int64, UInt8, UInt32, UInt64
from spike4dgs.benchmark.spikes.bits import copy_into, in_threads, kernel, rows
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream

_COUNTED = 4  # words, 256 ticks, from one count to the next: fewer take more memory, more take longer
_TYPES = np.uint64, np.uint32  # of words and counts


@dataclass(frozen=True, eq=False)
class SpikeTrains:
    """The spikes of P pixels in W = n_ticks // 64 + 1 words, those left out that are in doubt."""

    words: UInt64  # [W, P] bit t & 63 of words[t >> 6, p]: pixel p fired in tick t
    before: UInt32  # [ceil(W / _COUNTED), P] spikes before word _COUNTED k
    lost: Int64  # [n_ticks + 1] filled ticks before each tick, and before the end
    doubt_words: UInt64  # [2, ...] as `words`, of filled ticks alone, in order: those in doubt, and their spikes
    doubt_before: UInt32  # [2, ...] as `before`

    @property
    def arrays(self) -> tuple[UInt64, UInt32, Int64, UInt64, UInt32]:
        """The fields, for kernels."""
        return self.words, self.before, self.lost, self.doubt_words, self.doubt_before


@lru_cache(maxsize=1)
def spike_trains(stream: SpikeStream) -> SpikeTrains:
    """Return the trains of a stream, cached for the last one: images are made stream by stream."""
    pixels, kept = stream.height * stream.width, present(stream.filled, stream.n_ticks)
    lost = np.concatenate([[0], np.cumsum(~kept)]).astype(np.int64)
    if not stream.filled:
        return SpikeTrains(*_turned(stream.packed, pixels), lost, *(np.empty((2, 0, 0), t) for t in _TYPES))
    filled = stream.packed[~kept]
    doubt = np.full_like(filled, 255) if stream.certain is None else ~stream.certain
    apart = [_turned(packed, pixels) for packed in (doubt, filled & doubt)]
    words, before = (np.stack(arrays) for arrays in zip(*apart, strict=True))
    known = _turned(stream.packed, pixels, np.flatnonzero(~kept), words[0])
    return SpikeTrains(*known, lost, words, before)


def trains_bytes(stream: SpikeStream) -> int:
    """Return the bytes that the trains of a stream without filled ticks take."""
    shapes = _shapes(stream.n_ticks, stream.height * stream.width)
    return sum(math.prod(s) * np.dtype(t).itemsize for s, t in zip(shapes, _TYPES, strict=True))


def _turned(
    packed: UInt8, pixels: int, ticks: Int64 | None = None, doubt: UInt64 | None = None
) -> tuple[UInt64, UInt32]:
    """Return words and counts of packed ticks; of filled `ticks` without the pixels whose bit of `doubt` is set."""
    words, before = (np.empty(s, t) for s, t in zip(_shapes(len(packed), pixels), _TYPES, strict=True))
    in_threads(_turn, len(words), rows(packed), words)
    if doubt is not None:
        in_threads(_leave_out, pixels, words, ticks, doubt)
    in_threads(_accumulate, pixels, words, before)
    return words, before


def _shapes(n_ticks: int, pixels: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the shapes of words and counts."""
    count = n_ticks // 64 + 1
    return (count, pixels), (-(-count // _COUNTED), pixels)


@kernel
def _turn(packed: UInt8, words: UInt64, start: int, stop: int) -> None:
    """Set words [start, stop), eight ticks of eight pixels at a time."""
    for w in range(start, stop):
        for byte in range(packed.shape[1]):
            first, pixels = 8 * byte, min(8, words.shape[1] - 8 * byte)
            for p in range(pixels):
                words[w, first + p] = 0
            for group in range(8):
                square, tick = np.uint64(0), 64 * w + 8 * group
                for t in range(min(8, len(packed) - tick)):
                    square |= np.uint64(packed[tick + t, byte]) << np.uint64(8 * t)
                square = _transposed(square)
                for p in range(pixels):
                    ticks = square >> np.uint64(8 * p) & np.uint64(255)
                    words[w, first + p] |= ticks << np.uint64(8 * group)


@kernel
def _transposed(x: Any) -> Any:
    """Return a square of 8 x 8 bits with rows as columns: swap single bits, then squares of 2 x 2, then of 4 x 4."""
    t = (x ^ (x >> np.uint64(7))) & np.uint64(0x00AA00AA00AA00AA)
    x = x ^ t ^ (t << np.uint64(7))
    t = (x ^ (x >> np.uint64(14))) & np.uint64(0x0000CCCC0000CCCC)
    x = x ^ t ^ (t << np.uint64(14))
    t = (x ^ (x >> np.uint64(28))) & np.uint64(0x00000000F0F0F0F0)
    return x ^ t ^ (t << np.uint64(28))


@kernel
def _leave_out(words: UInt64, ticks: Int64, doubt: UInt64, start: int, stop: int) -> None:
    """Clear the bits of pixels [start, stop) in some ticks, the k-th one's where bit k of their `doubt` is set."""
    for k in range(len(ticks)):
        w, bit = ticks[k] >> 6, np.uint64(ticks[k] & 63)
        for p in range(start, stop):
            words[w, p] &= ~((doubt[k >> 6, p] >> np.uint64(k & 63) & np.uint64(1)) << bit)


@kernel
def _accumulate(words: UInt64, before: UInt32, start: int, stop: int) -> None:
    """Set the counts of pixels [start, stop)."""
    total = np.zeros(stop - start, np.uint32)
    for w in range(len(words)):
        if w % _COUNTED == 0:
            copy_into(total, before[w // _COUNTED, start:stop])
        for p in range(start, stop):
            total[p - start] += np.uint32(_ones(words[w, p]))


def _instruction(emit: Any) -> Any:
    """Return an instruction on a word as a function for kernels."""

    def typed(typing_context: Any, word: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return emit(builder, args[0])

        return types.int64(types.uint64), codegen

    return intrinsic(typed)


_DEFINED_AT_0 = ir.Constant(ir.IntType(1), 0)
_ones = _instruction(lambda builder, word: builder.ctpop(word))
_zeros_below = _instruction(lambda builder, word: builder.cttz(word, _DEFINED_AT_0))
_zeros_above = _instruction(lambda builder, word: builder.ctlz(word, _DEFINED_AT_0))


@kernel
def count_before(words: UInt64, before: UInt32, pixel: int, tick: int) -> int:
    """Return the number of a pixel's spikes before a tick in [0, n_ticks]."""
    last = tick >> 6
    count = np.int64(before[last // _COUNTED, pixel])
    for w in range(last // _COUNTED * _COUNTED, last):
        count += _ones(words[w, pixel])
    return int(count + _ones(words[last, pixel] & ((np.uint64(1) << np.uint64(tick & 63)) - np.uint64(1))))


@kernel
def first_from(words: UInt64, pixel: int, tick: int) -> int:
    """Return the tick of a pixel's first spike at or after a tick in [0, n_ticks], of which there must be one."""
    w = tick >> 6
    found = words[w, pixel] >> np.uint64(tick & 63) << np.uint64(tick & 63)
    while found == 0:
        w += 1
        found = words[w, pixel]
    return int(64 * w + _zeros_below(found))


@kernel
def last_before(words: UInt64, pixel: int, tick: int) -> int:
    """Return the tick of a pixel's last spike before a tick in [0, n_ticks], of which there must be one."""
    w = tick >> 6
    found = words[w, pixel] & ((np.uint64(1) << np.uint64(tick & 63)) - np.uint64(1))
    while found == 0:
        w -= 1
        found = words[w, pixel]
    return int(64 * w + 63 - _zeros_above(found))
