"""The tile jobs: sort a tile's Gaussians, list the blocks each meets, and composite or differentiate them.

Large tiles keep sorting cheap; inside a tile a Gaussian visits only the blocks (8 pixels wide) of the rows that its
opacity-aware ellipse meets: 1.6 to 2 lanes are computed per useful pixel, against 6 to 13 for whole 16 x 16 tiles.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np

from spike4dgs.method.splat.kernels.blend_ir import (
    BLOCK_WIDTH,
    MOMENTS,
    PLANE,
    ROW_WIDTH,
    TILE_HEIGHT,
    TILE_WIDTH,
    Variant,
    any_unfinished,
    composite_blocks,
    differentiate_blocks,
    emit_blocks,
)
from spike4dgs.method.splat.kernels.jit import helper, kernel, source_digest, template
from spike4dgs.method.splat.kernels.project import ceil_int, floor_int
from spike4dgs.method.splat.kernels.tiles import sort_tile
from spike4dgs.method.splat.kernels.vector_ir import fetch_add, prefetch

BATCH = 128  # Gaussians whose blocks are listed at a time
AHEAD = 6  # Gaussians between prefetch and use; `order` is padded by as many
SLACK = 0.501  # half a pixel, and a margin for the rounding of the row bounds
MAX_BLOCKS = BATCH * TILE_HEIGHT * (TILE_WIDTH // BLOCK_WIDTH + 1) + 2 * TILE_HEIGHT  # longest list of one batch


def record_width(channels: int) -> int:
    """Return the number of floats in the gradient record of a Gaussian-tile pair."""
    return -(-(MOMENTS + channels) // 8) * 8


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
def list_blocks(variant: Any, records: Any, order: Any, begin: int, end: int, box: Any, rows: int, lists: Any) -> None:
    """List the blocks of the Gaussians order[begin:end] in the tile box (x0, x1, y0, y1).

    lists: starts, xis, etas of the blocks, and ends, where the k-th Gaussian's run ends.
    """
    at = 0
    for m in range(begin, end):
        prefetch(records, np.int64(order[m + AHEAD]) * 8)
        g = load_record(records, np.int64(order[m]) * 8)
        x = max(ceil_int(max(g[0] - g[3] - 0.5, 0.0)), box[0])
        x_end = min(floor_int(min(g[0] + g[3] + 0.5, float(box[1]))), box[1])
        at = list_column(variant, g, x, x_end, box, rows, lists, at)
        # Usually empty, but computing it costs less than a mispredicted branch.
        at = list_column(variant, g, x + BLOCK_WIDTH, x_end, box, rows, lists, at)
        x += 2 * BLOCK_WIDTH
        while x < x_end:
            at = list_column(variant, g, x, x_end, box, rows, lists, at)
            x += BLOCK_WIDTH
        lists[3][m - begin] = at


@helper
def tile_box(tile: int, width: int, height: int) -> Any:
    """Return the pixel bounds x0, x1, y0, y1 of a tile."""
    across = (width + TILE_WIDTH - 1) // TILE_WIDTH
    x0, y0 = tile % across * TILE_WIDTH, tile // across * TILE_HEIGHT
    return x0, min(x0 + TILE_WIDTH, width), y0, min(y0 + TILE_HEIGHT, height)


@cache
def raster_kernels(lanes: int, channels: int) -> tuple[Any, Any]:
    """Return the (forward, backward) tile kernels for this vector length and number of colour channels.

    numba's cache key covers integers in a closure, but neither global variables nor intrinsics: so everything that
    varies is in `variant`, and all else is global.
    """
    choice = Variant(lanes, channels, source_digest())
    variant, rows = choice.pack(), choice.block_rows

    @kernel
    def raster_forward(
        records: Any, colors: Any, pairs: Any, order: Any, offsets: Any, width: int, height: int, image: Any,
        alpha: Any, processed: Any, counter: Any, buffer: Any, starts: Any, xis: Any, etas: Any, ends: Any,
        digits: Any, spare: Any,
    ) -> None:  # fmt: skip
        """Composite all tiles.

        records [N * 8]; colors [chunks, N * channels]; image [chunks * channels, H, W] and alpha [H, W] are written;
        processed [chunks, tiles]: number of a tile's Gaussians that were visited before every pixel was finished.
        """
        while True:
            tile = fetch_add(counter, 0, 1)
            if tile >= offsets.shape[0] - 1:
                break
            box = tile_box(tile, width, height)
            x0, x1, y0, y1 = box
            begin, end = offsets[tile], offsets[tile + 1]
            sort_tile(pairs, spare, order, begin, end - begin, digits)
            vectors = (y1 - y0 + rows - 1) // rows * ROW_WIDTH * rows // lanes
            for chunk in range(colors.shape[0]):
                chunk_colors = colors[chunk]
                buffer[:PLANE] = -1.0  # what lies outside the image counts as finished
                buffer[PLANE : PLANE * (1 + channels)] = 0.0
                for y in range(y1 - y0):
                    row = y // rows * ROW_WIDTH * rows + y % rows
                    for x in range(x1 - x0):
                        buffer[row + x * rows] = 1.0
                at = begin
                while at < end and any_unfinished(variant, buffer, vectors):
                    stop = min(end, at + BATCH)
                    list_blocks(variant, records, order, at, stop, box, rows, (starts, xis, etas, ends))
                    first = 0
                    for k in range(stop - at):
                        last, i = np.int64(ends[k]), np.int64(order[at + k])
                        composite_blocks(variant, buffer, records, chunk_colors, starts, xis, etas, first, last, i)
                        first = last
                    at = stop
                processed[chunk, tile] = at - begin
                for y in range(y1 - y0):
                    row = y // rows * ROW_WIDTH * rows + y % rows
                    for x in range(x1 - x0):
                        alpha[y0 + y, x0 + x] = np.float32(1.0) - abs(buffer[row + x * rows])
                    for c in range(channels):
                        for x in range(x1 - x0):
                            value = buffer[PLANE * (1 + c) + row + x * rows]
                            image[chunk * channels + c, y0 + y, x0 + x] = value

    @kernel
    def raster_backward(
        records: Any, colors: Any, order: Any, slots: Any, tiles: Any, offsets: Any, processed: Any, width: int,
        height: int, image: Any, alpha: Any, d_image: Any, d_alpha: Any, sums: Any, counter: Any, buffer: Any,
        starts: Any, xis: Any, etas: Any, ends: Any,
    ) -> None:  # fmt: skip
        """Write the gradients of all tiles to sums [chunks, pairs * record width], see project_gradient.py."""
        width_of_record = (MOMENTS + channels + 7) // 8 * 8
        while True:
            tile = fetch_add(counter, 0, 1)
            if tile >= offsets.shape[0] - 1:
                break
            box = tile_box(tile, width, height)
            x0, x1, y0, y1 = box
            tx, ty = x0 // TILE_WIDTH, y0 // TILE_HEIGHT
            for chunk in range(colors.shape[0]):
                chunk_colors = colors[chunk]
                buffer[:PLANE] = -1.0
                buffer[PLANE : PLANE * (3 + channels)] = 0.0
                for y in range(y1 - y0):
                    row = y // rows * ROW_WIDTH * rows + y % rows
                    for x in range(x1 - x0):
                        at = row + x * rows
                        # the alpha image belongs to the first chunk
                        own = d_alpha[y0 + y, x0 + x] if chunk == 0 else np.float32(0.0)
                        rest = own * alpha[y0 + y, x0 + x]
                        for c in range(channels):
                            d = d_image[chunk * channels + c, y0 + y, x0 + x]
                            buffer[PLANE * (2 + c) + at] = d
                            rest += d * image[chunk * channels + c, y0 + y, x0 + x]
                        buffer[at] = 1.0
                        buffer[PLANE + at] = rest
                        buffer[PLANE * (2 + channels) + at] = own
                begin = offsets[tile]
                end = begin + processed[chunk, tile]
                at = begin
                while at < end:
                    stop = min(end, at + BATCH)
                    list_blocks(variant, records, order, at, stop, box, rows, (starts, xis, etas, ends))
                    first = 0
                    for k in range(stop - at):
                        last, i = np.int64(ends[k]), np.int64(order[at + k])
                        row = np.int64(slot_of(slots, tiles, i, tx, ty)) * width_of_record
                        differentiate_blocks(
                            variant, buffer, records, chunk_colors, starts, xis, etas, sums[chunk], first, last, i, row
                        )  # fmt: skip
                        first = last
                    at = stop
                for m in range(end, offsets[tile + 1]):
                    row = np.int64(slot_of(slots, tiles, order[m], tx, ty)) * width_of_record
                    sums[chunk, row : row + width_of_record] = 0.0

    return raster_forward, raster_backward


@helper
def slot_of(slots: Any, tiles: Any, i: int, tx: int, ty: int) -> int:
    """Return the gradient record of Gaussian i in tile (tx, ty)."""
    return slots[i] + (ty - tiles[i, 2]) * (tiles[i, 1] - tiles[i, 0]) + tx - tiles[i, 0]
