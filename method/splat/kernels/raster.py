"""The tile jobs: sort a tile's Gaussians, list the blocks each meets, and composite or differentiate them.

Large tiles keep sorting cheap, as Gaussians visit only the blocks that they meet (tiles.py). Behind and between the
Gaussians there may be a `Layer` of others that never change: their sorted lists are merged on the way.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from spike4dgs.method.splat.kernels.blend_ir import (
    MOMENTS,
    PLANE,
    ROW_WIDTH,
    TILE_HEIGHT,
    TILE_WIDTH,
    Variant,
    any_unfinished,
    composite_blocks,
    differentiate_blocks,
    replay_blocks,
)
from spike4dgs.method.splat.kernels.jit import helper, kernel, source_digest
from spike4dgs.method.splat.kernels.tiles import BATCH, list_blocks, sort_tile
from spike4dgs.method.splat.kernels.vector_ir import fetch_add


class Lists(NamedTuple):
    """N Gaussians in V views, and their P Gaussian-tile pairs: tile by tile, nearest first once they are composited."""

    records: np.ndarray  # [V, N * 8] float64
    keys: np.ndarray  # [V, N] uint32: depth bits
    colors: np.ndarray  # [V or 1, chunks, N * channels] float32
    order: np.ndarray  # [P] int32, the Gaussians' indices
    offsets: np.ndarray  # [V * tiles + 1] int64, of each tile's pairs


class Layer(NamedTuple):
    """M Gaussians that never change, in all views, or empty arrays. B: their Gaussian-tile pairs, nearest first."""

    chosen: np.ndarray  # [V] int64: the rendered views among those of the layer
    records: np.ndarray  # [views, M * 8] float64
    colors: np.ndarray  # [chunks, M * channels] float32
    order: np.ndarray  # [B] int32
    keys: np.ndarray  # [B] uint32: depth bits
    offsets: np.ndarray  # [views * tiles + 1] int64
    image: np.ndarray  # [views, layers, H, W] float32
    alpha: np.ndarray  # [views, H, W] float32


def record_width(channels: int) -> int:
    """Return the number of floats in the gradient record of a Gaussian-tile pair."""
    return -(-(MOMENTS + channels) // 8) * 8


@helper
def tile_box(tile: int, width: int, height: int) -> Any:
    """Return the pixel bounds x0, x1, y0, y1 of a tile."""
    across = (width + TILE_WIDTH - 1) // TILE_WIDTH
    x0, y0 = tile % across * TILE_WIDTH, tile // across * TILE_HEIGHT
    return x0, min(x0 + TILE_WIDTH, width), y0, min(y0 + TILE_HEIGHT, height)


@helper
def tile_count(width: int, height: int) -> int:
    """Return the number of tiles of an image."""
    return (width + TILE_WIDTH - 1) // TILE_WIDTH * ((height + TILE_HEIGHT - 1) // TILE_HEIGHT)


@helper
def layer_pairs(layer: Any, view: int, tile: int, tiles: int) -> Any:
    """Return where a tile's pairs begin and end in a layer, which may be empty."""
    if len(layer.offsets) < 2:
        return np.int64(0), np.int64(0)
    item = layer.chosen[view] * tiles + tile
    return layer.offsets[item], layer.offsets[item + 1]


@helper
def copy_tile(layer: Any, view: int, box: Any, image: Any, alpha: Any) -> None:
    """Copy a tile of a layer's image and alpha [H, W] into those of a view."""
    x0, x1, y0, y1 = box
    source = layer.chosen[view]
    for y in range(y0, y1):
        for x in range(x0, x1):
            alpha[view, y, x] = layer.alpha[source, y, x]
        for c in range(image.shape[1]):
            for x in range(x0, x1):
                image[view, c, y, x] = layer.image[source, c, y, x]


@helper
def merge_batch(
    order: Any, keys: Any, at: int, end: int, layer: Any, other: int, last: int, mixed: Any, all_: bool
) -> Any:
    """Merge up to BATCH of the pairs at .. end with a layer's other .. last, nearest first.

    mixed gets the index i of a Gaussian, or -1 - i of one of the layer. Returns how many there are, and the first pair
    of each side that is left. Without `all_`, what follows the last of the first side is left out.
    """
    count = 0
    while count < BATCH and (at < end or (all_ and other < last)):
        nearer = other < last and (at == end or layer.keys[other] <= keys[order[at]])
        if nearer:
            mixed[count] = -1 - layer.order[other]
            other += 1
        else:
            mixed[count] = order[at]
            at += 1
        count += 1
    return count, at, other


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
        lists: Any, pairs: Any, layer: Any, width: int, height: int, image: Any, alpha: Any, processed: Any,
        counter: Any, buffer: Any, starts: Any, xis: Any, etas: Any, ends: Any, mixed: Any, digits: Any, spare: Any,
    ) -> None:  # fmt: skip
        """Composite all tiles of all views.

        pairs [P] are sorted into `lists.order`; image [V, chunks * channels, H, W] and alpha [V, H, W] are written;
        processed [chunks, V * tiles]: number of a tile's Gaussians that were visited before every pixel was finished.
        """
        tiles = tile_count(width, height)
        while True:
            item = fetch_add(counter, 0, 1)
            if item >= len(lists.offsets) - 1:
                break
            view, tile = item // tiles, item % tiles
            box = tile_box(tile, width, height)
            x0, x1, y0, y1 = box
            begin, end = lists.offsets[item], lists.offsets[item + 1]
            if end == begin and len(layer.offsets) > 1:
                processed[:, item] = 0
                copy_tile(layer, view, box, image, alpha)
                continue
            records, keys, order = lists.records[view], lists.keys[view], lists.order
            sort_tile(pairs, spare, order, begin, end - begin, digits)
            layer_records = layer.records[layer.chosen[view]] if len(layer.offsets) > 1 else records
            vectors = (y1 - y0 + rows - 1) // rows * ROW_WIDTH * rows // lanes
            for chunk in range(lists.colors.shape[1]):
                colors = lists.colors[view if lists.colors.shape[0] > 1 else 0, chunk]
                layer_colors = layer.colors[chunk] if len(layer.offsets) > 1 else colors
                buffer[:PLANE] = -1.0  # what lies outside the image counts as finished
                buffer[PLANE : PLANE * (1 + channels)] = 0.0
                for y in range(y1 - y0):
                    row = y // rows * ROW_WIDTH * rows + y % rows
                    for x in range(x1 - x0):
                        buffer[row + x * rows] = 1.0
                at = begin
                other, last_other = layer_pairs(layer, view, tile, tiles)
                while (at < end or other < last_other) and any_unfinished(variant, buffer, vectors):
                    count, at, other = merge_batch(order, keys, at, end, layer, other, last_other, mixed, True)
                    blocks = (starts, xis, etas, ends)
                    list_blocks(variant, records, layer_records, mixed, count, box, rows, blocks)
                    first = 0
                    for k in range(count):
                        last, i = np.int64(ends[k]), np.int64(mixed[k])
                        own_records, own_colors = (records, colors) if i >= 0 else (layer_records, layer_colors)
                        i = max(i, -1 - i)
                        composite_blocks(variant, buffer, own_records, own_colors, starts, xis, etas, first, last, i)
                        first = last
                processed[chunk, item] = at - begin
                for y in range(y1 - y0):
                    row = y // rows * ROW_WIDTH * rows + y % rows
                    for x in range(x1 - x0):
                        alpha[view, y0 + y, x0 + x] = np.float32(1.0) - abs(buffer[row + x * rows])
                    for c in range(channels):
                        for x in range(x1 - x0):
                            value = buffer[PLANE * (1 + c) + row + x * rows]
                            image[view, chunk * channels + c, y0 + y, x0 + x] = value

    @kernel
    def raster_backward(
        lists: Any, slots: Any, boxes: Any, layer: Any, width: int, height: int, image: Any, alpha: Any, processed: Any,
        d_image: Any, d_alpha: Any, sums: Any, counter: Any, buffer: Any, starts: Any, xis: Any, etas: Any, ends: Any,
        mixed: Any,
    ) -> None:  # fmt: skip
        """Write the gradients of all tiles to sums [chunks, pairs * record width], see project_gradient.py.

        A tile is done with its last Gaussian that has gradients, as R there comes from the image. slots [V, N + 1] and
        boxes [V, N, 4] are the projection's.
        """
        width_of_record = (MOMENTS + channels + 7) // 8 * 8
        tiles = tile_count(width, height)
        while True:
            item = fetch_add(counter, 0, 1)
            if item >= len(lists.offsets) - 1:
                break
            begin = lists.offsets[item]
            if begin == lists.offsets[item + 1]:
                continue
            view, tile = item // tiles, item % tiles
            box = tile_box(tile, width, height)
            x0, x1, y0, y1 = box
            tx, ty = x0 // TILE_WIDTH, y0 // TILE_HEIGHT
            records, keys, order = lists.records[view], lists.keys[view], lists.order
            slots_here, boxes_here = slots[view], boxes[view]
            layer_records = layer.records[layer.chosen[view]] if len(layer.offsets) > 1 else records
            for chunk in range(lists.colors.shape[1]):
                colors = lists.colors[view if lists.colors.shape[0] > 1 else 0, chunk]
                layer_colors = layer.colors[chunk] if len(layer.offsets) > 1 else colors
                chunk_sums = sums[chunk]
                buffer[:PLANE] = -1.0
                buffer[PLANE : PLANE * (3 + channels)] = 0.0
                for y in range(y1 - y0):
                    row = y // rows * ROW_WIDTH * rows + y % rows
                    for x in range(x1 - x0):
                        pixel = row + x * rows
                        # the alpha image belongs to the first chunk
                        own = d_alpha[view, y0 + y, x0 + x] if chunk == 0 else np.float32(0.0)
                        rest = own * alpha[view, y0 + y, x0 + x]
                        for c in range(channels):
                            d = d_image[view, chunk * channels + c, y0 + y, x0 + x]
                            buffer[PLANE * (2 + c) + pixel] = d
                            rest += d * image[view, chunk * channels + c, y0 + y, x0 + x]
                        buffer[pixel] = 1.0
                        buffer[PLANE + pixel] = rest
                        buffer[PLANE * (2 + channels) + pixel] = own
                other, last_other = layer_pairs(layer, view, tile, tiles)
                at, end = begin, begin + processed[chunk, item]
                while at < end:
                    count, at, other = merge_batch(order, keys, at, end, layer, other, last_other, mixed, False)
                    blocks = (starts, xis, etas, ends)
                    list_blocks(variant, records, layer_records, mixed, count, box, rows, blocks)
                    first = 0
                    for k in range(count):
                        last, i = np.int64(ends[k]), np.int64(mixed[k])
                        if i < 0:
                            replay_blocks(
                                variant, buffer, layer_records, layer_colors, starts, xis, etas, first, last, -1 - i
                            )
                        else:
                            row = np.int64(slot_of(slots_here, boxes_here, i, tx, ty)) * width_of_record
                            differentiate_blocks(
                                variant, buffer, records, colors, starts, xis, etas, chunk_sums, first, last, i, row
                            )
                        first = last
                for m in range(end, lists.offsets[item + 1]):
                    row = np.int64(slot_of(slots_here, boxes_here, order[m], tx, ty)) * width_of_record
                    sums[chunk, row : row + width_of_record] = 0.0

    return raster_forward, raster_backward


@helper
def slot_of(slots: Any, boxes: Any, i: int, tx: int, ty: int) -> int:
    """Return the gradient record of Gaussian i in tile (tx, ty)."""
    return slots[i] + (ty - boxes[i, 2]) * (boxes[i, 1] - boxes[i, 0]) + tx - boxes[i, 0]
