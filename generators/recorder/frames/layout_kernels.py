"""Kernels of the frame layouts with tags; `layouts` states the rules of the tags."""

from __future__ import annotations

import numpy as np

from spike4dgs.benchmark.arrays import Int64, UInt8
from spike4dgs.benchmark.spikes.bits import kernel

TORN = -1  # in place of a counter: the tags of a frame disagree
STEP, MIX = 257, 40503  # of the tags of `tagged-rows`
LINE_BITS = 10  # of the line number in a tag of `line-tagged`


@kernel
def _word(data: UInt8, at: int) -> int:
    """Return the little-endian word at data[at]; signed, because numba would make the shift of a byte unsigned."""
    return np.int64(data[at]) | np.int64(data[at + 1]) << 8  # type: ignore[return-value]


@kernel
def _tagged_count_at(data: UInt8, start: int, height: int, row_bytes: int) -> int:
    """Return the counter of the whole frame that begins at data[start]; TORN where its tags disagree."""
    at = start + row_bytes - 2
    low = _word(data, at)
    at += row_bytes
    odd = (_word(data, at) - STEP) & 65535
    for r in range(2, height):
        at += row_bytes
        if _word(data, at) != ((odd if r & 1 else low) + STEP * r) & 65535:
            return TORN
    return low + (((odd - MIX * low) & 65535) << 16)


@kernel
def count_tagged(raw: UInt8, height: int, row_bytes: int, out: Int64) -> None:
    """Write the counter of each frame of raw [n, frame_bytes] to out [n]; TORN where its tags disagree."""
    for i in range(len(raw)):
        out[i] = _tagged_count_at(raw[i], 0, height, row_bytes)


@kernel
def find_tagged(data: UInt8, height: int, row_bytes: int) -> int:
    """Return the offset of the first whole frame in data [n], or -1."""
    for start in range(len(data) - height * row_bytes + 1):
        if _tagged_count_at(data, start, height, row_bytes) >= 0:
            return start
    return -1


def line_tags(height: int) -> Int64:
    """Return line and channel (bits 0..9 and 10..11) of the blocks of a frame in their order, [2 H]."""
    row, side = np.arange(2 * height) // 2, np.arange(2 * height) % 2
    first = row < height // 2
    line = np.where(first, height // 2 - row, row - height // 2 + 1)
    return line | (np.where(first, side, 2 + side) << LINE_BITS)


@kernel
def _lines_at(data: UInt8, start: int, width: int, height: int) -> bool:
    """Return whether the blocks from data[start] on are a whole frame in the order of `line_tags`."""
    size = (width // 2 + 12) // 8
    half = height // 2
    for b in range(2 * height):
        at = start + (b + 1) * size - 2
        row, side = b // 2, b & 1
        tag = half - row | side << 10 if row < half else row - half + 1 | (2 + side) << 10
        if _word(data, at) >> 4 != tag:
            return False
    return True


@kernel
def check_lines(raw: UInt8, width: int, height: int, out: Int64) -> None:
    """Write 0 to out [n] for each sound frame of raw [n, frame_bytes], TORN for the others."""
    for i in range(len(raw)):
        out[i] = 0 if _lines_at(raw[i], 0, width, height) else TORN


@kernel
def find_lines(data: UInt8, width: int, height: int) -> int:
    """Return the offset of the first whole frame in data [n], or -1."""
    for start in range(len(data) - 2 * height * ((width // 2 + 12) // 8) + 1):
        if _lines_at(data, start, width, height):
            return start
    return -1


@kernel
def unpack_lines(raw: UInt8, n: int, out: UInt8) -> None:
    """Unpack blocks of n bytes, 4 pixels and 12 tag bits to rows of two blocks, out [frames * H, 2 n + 1]."""
    size = n + 2
    per_frame = raw.shape[1] // (2 * size)
    for i in range(len(out)):
        frame, at = raw[i // per_frame], (i % per_frame) * 2 * size
        left, right, row = frame[at : at + size], frame[at + size : at + 2 * size], out[i]
        for j in range(n):
            row[j] = left[j]
            row[n + 1 + j] = right[j] >> 4 | (right[j + 1] & 15) << 4
        row[n] = (left[n] & 15) | (right[0] & 15) << 4
