"""The blocks of a tile, 8 pixels wide, that a Gaussian meets, as lists for the inner loops of blend_ir.py.

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
from spike4dgs.method.splat.kernels.jit import helper, template
from spike4dgs.method.splat.kernels.project import ceil_int, floor_int
from spike4dgs.method.splat.kernels.vector_ir import I32, Lanes, offset, prefetch

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
