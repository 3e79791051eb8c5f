"""The tiles' lists of Gaussians, nearest first: offsets from block histograms, filling, and a radix sort."""

from __future__ import annotations

from typing import Any

import numpy as np

from spike4dgs.method.splat.kernels.jit import helper, kernel
from spike4dgs.method.splat.kernels.project import BLOCK, CULLED
from spike4dgs.method.splat.kernels.vector_ir import fetch_add


@kernel
def tile_offsets(histogram: Any, offsets: Any) -> int:
    """Turn the counts of `project_forward` into write positions, in place; return the number of pairs.

    histogram [V, blocks, 1 + tiles]: afterwards column 0 is each block's first pair (in Gaussian order), the others
    its first position in each tile's list; offsets [V * tiles + 1] bound the tiles' lists.
    """
    views, blocks, tiles = histogram.shape[0], histogram.shape[1], histogram.shape[2] - 1
    total, position = 0, 0
    for view in range(views):
        for b in range(blocks):
            count = histogram[view, b, 0]
            histogram[view, b, 0] = total
            total += count
        for tile in range(tiles):
            offsets[view * tiles + tile] = position
            for b in range(blocks):
                count = histogram[view, b, 1 + tile]
                histogram[view, b, 1 + tile] = position
                position += count
    offsets[views * tiles] = position
    return position


@kernel
def fill_tiles(keys: Any, tiles: Any, across: int, histogram: Any, slots: Any, pairs: Any, counter: Any) -> None:
    """Write each visible Gaussian into its tiles' lists, in index order: pairs [P] uint64 = depth bits << 32 | index.

    slots [V, N + 1]: Gaussian i of view v owns the gradient records slots[v, i]:slots[v, i + 1], one per tile it
    touches. The other arrays are as in `Projected`.
    """
    views, blocks, n = histogram.shape[0], histogram.shape[1], keys.shape[1]
    while True:
        item = fetch_add(counter, 0, 1)
        if item >= views * blocks:
            break
        v, block = item // blocks, item % blocks
        slot = histogram[v, block, 0]
        for i in range(block * BLOCK, min(n, block * BLOCK + BLOCK)):
            slots[v, i] = slot
            if keys[v, i] == CULLED:
                continue
            pair = (np.uint64(keys[v, i]) << np.uint64(32)) | np.uint64(i)
            box = tiles[v, i]
            slot += (box[1] - box[0]) * (box[3] - box[2])
            for ty in range(box[2], box[3]):
                for tx in range(box[0], box[1]):
                    column = 1 + ty * across + tx
                    pairs[histogram[v, block, column]] = pair
                    histogram[v, block, column] += 1
        if block == blocks - 1:
            slots[v, n] = slot


@helper
def sort_tile(pairs: Any, spare: Any, order: Any, begin: int, count: int, digits: Any) -> None:
    """Sort pairs[begin:begin + count] by depth, stably, 8 bits at a time (radix sort); order gets the indices.

    digits [1024] and spare [count] are scratch. A digit that all share, such as the exponent's, is skipped.
    """
    if count == 0:
        return
    digits[:] = 0
    for i in range(begin, begin + count):
        k = np.uint32(pairs[i] >> np.uint64(32))
        digits[k & 255] += 1
        digits[256 + ((k >> 8) & 255)] += 1
        digits[512 + ((k >> 16) & 255)] += 1
        digits[768 + (k >> 24)] += 1
    some_key = np.uint32(pairs[begin] >> np.uint64(32))
    in_spare = False
    for digit in range(4):
        base, shift = 256 * digit, np.uint64(32 + 8 * digit)
        if digits[base + ((some_key >> np.uint32(8 * digit)) & 255)] == count:
            continue
        position = np.int32(0)
        for value in range(base, base + 256):
            here = digits[value]
            digits[value] = position
            position += here
        for i in range(count):
            pair = spare[i] if in_spare else pairs[begin + i]
            bucket = base + np.int64((pair >> shift) & np.uint64(255))
            target = digits[bucket]
            digits[bucket] = target + 1
            if in_spare:
                pairs[begin + target] = pair
            else:
                spare[target] = pair
        in_spare = not in_spare
    for i in range(count):
        pair = spare[i] if in_spare else pairs[begin + i]
        order[begin + i] = np.int32(pair & np.uint64(0xFFFFFFFF))
