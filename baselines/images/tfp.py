"""TFP, texture from playback: the mean of the spikes in a window around the instant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, UInt8, UInt64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.bits import in_threads, kernel, lanes, rows
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.settings import Settings

Array = NDArray[Any]


@dataclass(frozen=True)
class TfpSettings(Settings):
    """TFP's window."""

    half_window: int = 20  # ticks on each side; 41 ticks in all are customary for this camera


HALF_WINDOW = TfpSettings.half_window


def tfp_image(stream: SpikeStream, tick: int, half_window: int = HALF_WINDOW) -> Float32:
    """Return spikes per tick [H, W] float32 over ticks [tick - half_window, tick + half_window).

    The window is centred on the tick's start. At the clip's ends it is cut, and the mean divides by its true length.
    Raises UserError for a half window outside 1 ... 32767.
    """
    _check(half_window)
    start, stop = max(0, tick - half_window), min(stream.n_ticks, tick + half_window)
    return stream.counts(start, stop).astype(np.float32) * (np.float32(1) / np.float32(stop - start))


def tfp_stack(stream: SpikeStream, half_window: int = HALF_WINDOW, out: Float32 | None = None) -> Float32:
    """Return `tfp_image` at every tick: spikes per tick [T, H, W] float32, by a running sum, into `out` if given.

    Time does not depend on the window: most of it goes into the result's memory. `count_stack` takes a quarter of both.
    """
    _check(half_window)
    if out is None:
        out = np.empty((stream.n_ticks, stream.height, stream.width), np.float32)
    ticks = np.arange(stream.n_ticks)
    lengths = np.minimum(ticks + half_window, stream.n_ticks) - np.maximum(ticks - half_window, 0)
    _fill(stream, half_window, np.float32(1) / lengths.astype(np.float32), out)
    return out


def count_stack(stream: SpikeStream, half_window: int = HALF_WINDOW) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Return spikes [T, H, W] in the window of `tfp_image` at every tick, in the smallest type for 2 * half_window."""
    _check(half_window)
    dtype = _dtype(half_window)
    out = np.empty((stream.n_ticks, stream.height, stream.width), dtype)
    _fill(stream, half_window, np.ones(stream.n_ticks, dtype), out)
    return out


def _dtype(half_window: int) -> Any:
    return np.uint8 if 2 * half_window <= 255 else np.uint16


def _check(half_window: int) -> None:
    if not 1 <= half_window <= 32767:
        raise problem("half_window", "1 to 32767 ticks", str(half_window), "choose a window in this range")


def _fill(stream: SpikeStream, half_window: int, scales: Array, out: Array) -> None:
    dtype = _dtype(half_window)
    bands = (stream.height + 7) // 8  # of eight rows, which are whole bytes at any width
    arguments = (rows(stream.packed), lanes(np.dtype(dtype).itemsize), np.empty(0, dtype), half_window)
    in_threads(_stack, bands, *arguments, scales, stream.rows_bottom_up, out, small=out.size < 1 << 20)


@kernel
def _stack(
    packed: UInt8,
    table: UInt64,
    lane: Array,
    half_window: int,
    scales: Array,
    flip: bool,
    out: Array,
    start: int,
    stop: int,
) -> None:
    """Set out[t] = scales[t] * counts in the window around t, for the stored rows of bands [start, stop)."""
    n, height, width = out.shape
    top, end = 8 * start, min(8 * stop, height)
    first, last = start * width, min(stop * width, packed.shape[1])
    y = height - end if flip else top
    sums = np.zeros((last - first) * table.shape[1], np.uint64)
    for t in range(min(half_window - 1, n)):
        _add(sums, packed[t, first:last], table)
    for t in range(n):
        if t + half_window <= n:
            _add(sums, packed[t + half_window - 1, first:last], table)
        if t > half_window:
            _subtract(sums, packed[t - half_window - 1, first:last], table)
        _scale(sums.view(lane.dtype), scales[t], flip, out[t, y : y + end - top])


@kernel
def _add(sums: UInt64, source: UInt8, table: UInt64) -> None:
    width = table.shape[1]
    for j in range(len(source)):
        for k in range(width):
            sums[np.uint64(width * j + k)] += table[source[np.uint64(j)], k]


@kernel
def _subtract(sums: UInt64, source: UInt8, table: UInt64) -> None:
    width = table.shape[1]
    for j in range(len(source)):
        for k in range(width):
            sums[np.uint64(width * j + k)] -= table[source[np.uint64(j)], k]


@kernel
def _scale(counts: Array, scale: Any, flip: bool, image: Array) -> None:
    height, width = image.shape
    for y in range(height):
        first = (height - 1 - y if flip else y) * width
        row = image[y]
        for x in range(width):
            row[np.uint64(x)] = counts[np.uint64(first + x)] * scale


TFP = ImageMaker(
    name="tfp",
    definition="mean of the spikes in ticks [t - half_window, t + half_window)",
    source="Zhu, Dong, Huang, Tian: A retina-inspired sampling method for visual texture reconstruction, ICME 2019",
    rate=lambda stream, tick, settings: tfp_image(stream, tick, settings.half_window),
    settings=TfpSettings(),
    label="from spike counts",
)
