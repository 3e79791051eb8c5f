"""The tiles' lists of Gaussians, nearest first, by a radix sort; and the blocks of a tile that a Gaussian meets.

A Gaussian visits only the blocks of the rows that its opacity-aware ellipse meets: 1.6 to 2 lanes are computed per
useful pixel, against 6 to 13 for whole 16 x 16 tiles.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from spike4dgs.method.splat.kernels.blend_ir import (
    BLOCK_WIDTH,
    ROW_WIDTH,
    TILE_HEIGHT,
    TILE_WIDTH,
    Generated,
    Variant,
    pointers_of,
)
from spike4dgs.method.splat.kernels.jit import helper, kernel, template
from spike4dgs.method.splat.kernels.project import BLOCK, CULLED, ceil_int, floor_int
from spike4dgs.method.splat.kernels.vector_ir import I32, Lanes, fetch_add, offset, prefetch


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


BATCH = 128  # Gaussians whose blocks are listed at a time
AHEAD = 6  # Gaussians between prefetch and use; `mixed` is padded by as many
SLACK = 0.501  # half a pixel, and a margin for the rounding of the row bounds
MAX_BLOCKS = BATCH * TILE_HEIGHT * (TILE_WIDTH // BLOCK_WIDTH + 1) + 2 * TILE_HEIGHT  # longest list of one batch


@intrinsic(prefer_literal=True)  # type: ignore[untyped-decorator]
def emit_blocks(
    typing_context: Any, variant: Any, starts: Any, xis: Any, etas: Any, at: Any, start: Any, xi: Any, eta: Any,
    eta_step: Any,
) -> Generated:  # fmt: skip
    """Append a column of blocks, top to bottom, to the list: always a tile's full height; the caller counts."""
    signature = types.void(
        variant, starts, xis, etas, types.int64, types.int64, types.float64, types.float64, types.float64
    )  # fmt: skip
    rows = Variant.unpack(variant.literal_value).block_rows

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        count = TILE_HEIGHT // rows
        v, steps = Lanes(builder, count), list(range(count))
        out = [
            offset(builder, p, args[4]) for p in pointers_of(context, builder, sig, args, "starts xis etas").values()
        ]
        down = ir.Constant(v.int_type, [ir.Constant(I32, k * ROW_WIDTH * rows) for k in steps])
        v.store(builder.add(v.splat(builder.trunc(args[5], I32)), down), out[0])
        v.store(v.splat(args[6]), out[1])
        v.store(v.fma(v.splat(args[8]), v.of([float(k) for k in steps]), v.splat(args[7])), out[2])
        return context.get_dummy_value()

    return signature, generate


@helper
def load_record(records: Any, r: int) -> Any:
    """Return the record at records[r:] as scalars, which the compiler can keep while the lists are written."""
    return (
        records[r], records[r + 1], records[r + 2], records[r + 3],
        records[r + 4], records[r + 5], records[r + 6], records[r + 7],
    )  # fmt: skip


@helper
def rows_met(g: Any, dx: float, box: Any, rows: int) -> Any:
    """Return the first and last + 1 block row, from the tile's top, where the ellipse meets columns dx .. dx + 7.

    dx: offset from the Gaussian's centre. The ellipse's upper and lower edge are the ridge line plus and minus
    ratio * sqrt(hx^2 - dx^2); their extremes in the columns lie at the topmost point or at the nearest column.
    """
    _, y, slope, hx, top_at, _, _, ratio = g
    left, right = max(dx, -hx), min(dx + (BLOCK_WIDTH - 1), hx)
    high, low = min(max(top_at, left), right), min(max(-top_at, left), right)
    far = y - box[2] + slope * high + ratio * math.sqrt(max(hx * hx - high * high, 0.0)) + SLACK
    near = y - box[2] + slope * low - ratio * math.sqrt(max(hx * hx - low * low, 0.0)) - SLACK
    height = float(box[3] - box[2])
    first = ceil_int(min(max(near, 0.0), height)) // rows
    return first, (floor_int(min(max(far, 0.0), height)) + rows - 1) // rows


@template
def list_column(variant: Any, g: Any, x: int, x_end: int, box: Any, rows: int, lists: Any, at: int) -> int:
    """Append the blocks of pixel columns x .. x + 7 and return the new length of the list. No branches."""
    dx = x + 0.5 - g[0]
    first, last = rows_met(g, dx, box, rows)
    eta = g[6] * (box[2] + first * rows + 0.5 - g[1] - g[2] * dx)
    start = (first * ROW_WIDTH + x - box[0]) * rows
    emit_blocks(variant, lists[0], lists[1], lists[2], at, start, g[5] * dx, eta, g[6] * rows)
    return at + (max(last - first, 0) if x < x_end else 0)


@template
def list_blocks(
    variant: Any, records: Any, layer_records: Any, mixed: Any, count: int, box: Any, rows: int, lists: Any
) -> None:  # fmt: skip
    """List the blocks of the Gaussians mixed[:count] (see `merge_batch`) in the tile box (x0, x1, y0, y1).

    lists: starts, xis, etas of the blocks, and ends, where the k-th Gaussian's run ends.
    """
    at = 0
    for k in range(count):
        ahead, i = np.int64(mixed[k + AHEAD]), np.int64(mixed[k])
        prefetch(records if ahead >= 0 else layer_records, max(ahead, -1 - ahead) * 8)
        g = load_record(records if i >= 0 else layer_records, max(i, -1 - i) * 8)
        x = max(ceil_int(max(g[0] - g[3] - 0.5, 0.0)), box[0])
        x_end = min(floor_int(min(g[0] + g[3] + 0.5, float(box[1]))), box[1])
        at = list_column(variant, g, x, x_end, box, rows, lists, at)
        # Usually empty, but computing it costs less than a mispredicted branch.
        at = list_column(variant, g, x + BLOCK_WIDTH, x_end, box, rows, lists, at)
        x += 2 * BLOCK_WIDTH
        while x < x_end:
            at = list_column(variant, g, x, x_end, box, rows, lists, at)
            x += BLOCK_WIDTH
        lists[3][k] = at
