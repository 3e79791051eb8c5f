"""Orientation of packed images: rows in reverse order, left and right exchanged."""

from __future__ import annotations

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.spikes.bits import kernel, rows


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
