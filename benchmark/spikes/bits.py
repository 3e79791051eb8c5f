"""Kernels on packed spikes: count and unpack bits without a plain array of the whole clip in between.

Two ideas carry everything. A table turns a byte into one machine word that holds its eight bits as eight numbers
(`lanes`), so that one 64-bit addition adds eight pixels. And a vertical counter keeps bit k of every pixel's count in
plane k, so that one bitwise operation on a plane serves every pixel of a vector register.

Three habits keep LLVM's vectoriser at work: inner loops are small functions over one-dimensional arrays, with unsigned
indices (no test for negative ones), and they load before they choose (`a if fired else b` on values, not on elements).
The kernels release the GIL and work on plain arrays and memory maps. The ranges that threads work on never overlap in
the output, so the number of threads changes no bit of it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import UInt8, UInt64
from spike4dgs.benchmark.compilation import cached_njit
from spike4dgs.benchmark.environment import available_cores

F = TypeVar("F", bound=Callable[..., Any])

_BLOCK = 1024  # bytes of a tick counted at a time: eight planes and a carry of 1 KiB each stay in the L1 cache
SMALL = 1 << 21  # bytes of input below which starting threads costs more than it saves


def kernel(function: F) -> F:
    """Compile with numba: no GIL, cached on disk; 1 / 0 is infinity, as in numpy, because a test would stop vectors."""
    return cast(F, cached_njit(nogil=True, error_model="numpy")(function))


def in_threads(function: Callable[..., None], n: int, *args: object, small: bool = False) -> None:
    """Call `function(*args, start, stop)` on ranges that cover [0, n), one range per core; on one if `small`.

    `function` must not call this again: all calls share one pool, whose threads would wait for one another.
    """
    parts = 1 if small else max(1, min(n, available_cores()))
    edges = [n * i // parts for i in range(parts + 1)]
    jobs = [_pool().submit(function, *args, a, b) for a, b in zip(edges[1:-1], edges[2:], strict=True)]
    try:
        function(*args, 0, edges[1])
    finally:  # no thread writes into the arguments once this has returned
        wait(jobs)
    for job in jobs:
        job.result()


@cache
def _pool() -> ThreadPoolExecutor:
    """Return the threads beside the calling one: images of a clip are hundreds of calls, and a pool costs as much."""
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="bits")


def rows(packed: UInt8) -> UInt8:
    """Return the same bytes as a plain, contiguous, read-only array: the one type that kernels are compiled for."""
    view = np.ascontiguousarray(packed).view(np.ndarray)
    view.flags.writeable = False
    return view


def lanes(width: int) -> UInt64:
    """Return a table [256, width]: the eight bits of a byte as eight numbers in `width` words (uint8: 1, uint16: 2)."""
    bits = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1, bitorder="little")
    return bits.astype(np.dtype(f"u{width}")).view(np.uint64)


def count_bits(packed: UInt8, n_pixels: int) -> NDArray[np.uint16]:
    """Sum over ticks of each of the first `n_pixels` bits of rows [n, bytes] -> [n_pixels] uint16, n <= 65535."""
    counts = np.zeros(packed.shape[1] * 8, np.uint16)
    in_threads(_count, packed.shape[1], rows(packed), lanes(2), counts, small=packed.size < SMALL)
    return counts[:n_pixels]


@kernel
def _count(packed: UInt8, table: UInt64, counts: NDArray[np.uint16], start: int, stop: int) -> None:
    n = len(packed)
    words = counts.view(np.uint64)  # four uint16 counts each
    planes = np.empty((8, _BLOCK), np.uint8)
    carry = np.empty(_BLOCK, np.uint8)
    for first in range(start, stop, _BLOCK):
        size = min(_BLOCK, stop - first)
        for group in range(0, n, 255):  # eight planes count to 255
            planes[:] = 0
            for t in range(group, min(group + 255, n)):
                copy_into(packed[t, first : first + size], carry)
                reached = t - group + 1  # no count is larger yet, so higher planes receive no carry
                level = 0
                while reached > 0:
                    plane = planes[level]
                    for j in range(size):
                        p, c = plane[j], carry[j]
                        plane[j] = p ^ c
                        carry[j] = p & c
                    reached >>= 1
                    level += 1
            for level in range(8):
                for j in range(size):
                    words[2 * (first + j)] += table[planes[level, j], 0] << np.uint64(level)
                    words[2 * (first + j) + 1] += table[planes[level, j], 1] << np.uint64(level)


@kernel
def copy_into(source: NDArray[Any], target: NDArray[Any]) -> None:
    """Copy to the beginning of an array. Numba compiles seconds for `target[:n] = source`: an error about shapes."""
    for j in range(np.uint64(len(source))):  # unsigned: no index counts from the end
        target[j] = source[j]


def unpack(packed: UInt8, width: int, height: int, flip: bool) -> UInt8:
    """Unpack rows [n, bytes] to [n, height, width] of 0 and 1, with the rows in reverse order if `flip`."""
    out = np.empty((len(packed), height, width), np.uint8)
    small = packed.size < SMALL // 8
    if width % 8 == 0:
        in_threads(_unpack_bytes, len(packed), rows(packed), lanes(1)[:, 0], flip, out.view(np.uint64), small=small)
    else:
        in_threads(_unpack_any, len(packed), rows(packed), lanes(1)[:, 0], flip, out, small=small)
    return out


@kernel
def _unpack_bytes(packed: UInt8, table: UInt64, flip: bool, out: UInt64, start: int, stop: int) -> None:
    height, words = out.shape[1:]
    for t in range(start, stop):
        for y in range(height):  # in the order of the output: writing downwards takes twice as long
            r = height - 1 - y if flip else y
            expand(packed[t, r * words : (r + 1) * words], table, out[t, y])


@kernel
def _unpack_any(packed: UInt8, table: UInt64, flip: bool, out: UInt8, start: int, stop: int) -> None:
    height, width = out.shape[1:]
    words = np.empty(packed.shape[1], np.uint64)  # one tick, because here rows do not begin on whole bytes
    for t in range(start, stop):
        expand(packed[t], table, words)
        _copy_rows(words.view(np.uint8), flip, out[t])


@kernel
def expand(source: UInt8, table: UInt64, words: UInt64) -> None:
    """Set words[j] = table[source[j]]: bytes [n] to words [n] of eight lanes each."""
    for j in range(len(source)):
        words[np.uint64(j)] = table[source[np.uint64(j)]]


@kernel
def _copy_rows(flat: UInt8, flip: bool, image: UInt8) -> None:
    """Copy stored pixels [>= H * W] to an image [H, W], in reverse order of rows if `flip`."""
    height, width = image.shape
    for y in range(height):
        first = (height - 1 - y if flip else y) * width
        row = image[y]
        for x in range(width):
            row[np.uint64(x)] = flat[np.uint64(first + x)]


@kernel
def find_spike(packed: UInt8, pixel: int, tick: int, step: int) -> int:
    """Return the first tick with a spike of a stored pixel, from `tick` in direction `step`; -1 where there is none."""
    byte, bit = pixel >> 3, pixel & 7
    while 0 <= tick < len(packed):
        if packed[tick, byte] >> bit & 1:
            return tick
        tick += step
    return -1


# Orientation of packed images: rows in reverse order, left and right exchanged.


def orient(packed: UInt8, width: int, height: int, flip: bool, mirror: bool) -> UInt8:
    """Return packed ticks [n, bytes], with the rows in reverse order if `flip`, left and right exchanged if `mirror`.

    Both together turn the image by 180 degrees. Without either, the result is `packed` itself.
    """
    if not (flip or mirror):
        return packed
    out = np.zeros(packed.shape, np.uint8)
    if width % 8 == 0:
        reverse = np.packbits(np.unpackbits(np.arange(256, dtype=np.uint8)), bitorder="little")
        _orient_bytes(rows(packed), height, flip, mirror, reverse, out)
    else:  # rows do not begin on whole bytes
        _orient_bits(rows(packed), width, height, flip, mirror, out)
    return out


@kernel
def _orient_bytes(packed: UInt8, height: int, flip: bool, mirror: bool, reverse: UInt8, out: UInt8) -> None:
    size = packed.shape[1] // height
    for t in range(len(packed)):
        for y in range(height):
            r = height - 1 - y if flip else y
            source, target = packed[t, r * size : (r + 1) * size], out[t, y * size : (y + 1) * size]
            for j in range(size):
                target[j] = reverse[source[size - 1 - j]] if mirror else source[j]


@kernel
def _orient_bits(packed: UInt8, width: int, height: int, flip: bool, mirror: bool, out: UInt8) -> None:
    for t in range(len(packed)):
        for y in range(height):
            for x in range(width):
                p = (height - 1 - y if flip else y) * width + (width - 1 - x if mirror else x)
                q = y * width + x
                out[t, q >> 3] |= ((packed[t, p >> 3] >> (p & 7)) & 1) << (q & 7)
