"""TFI, texture from inter-spike intervals: one over the interval that contains the instant.

A spike of tick k fires between the instants k and k + 1, so the interval that contains the start of tick t runs from
the last spike before t to the first spike at or after t; over it the pixel has collected one spike's worth of light.
Spikes are known to the tick, so an interval of k ticks was k - 1 to k + 1 long; plain 1 / k is the field's choice, and
its mean over time is the spike rate.

There is no limit to the search, so dark pixels get their rate and not a floor. Where the interval reaches over an end
of the clip, the pixel takes the nearest complete interval, or the part of its own that lies in the clip if that is
longer; with one spike in the whole clip it is 1 / (length of the clip), the mean rate; with none it is 0.
"""

from __future__ import annotations

import numpy as np

from spike4dgs.benchmark.arrays import Float32, UInt8, UInt64
from spike4dgs.benchmark.spikes.bits import expand, find_spike, in_threads, kernel, lanes, rows
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.base import ImageMaker

_BLOCK = 128  # bytes of a tick done at a time in the stack: 1024 pixels


def tfi_image(stream: SpikeStream, tick: int) -> Float32:
    """Return spikes per tick [H, W] float32: 1 / the interval of each pixel that contains the start of `tick`."""
    image = np.empty(stream.height * stream.width, np.float32)
    in_threads(_image, len(image), rows(stream.packed), tick, image, small=len(image) < 1 << 14)
    upright = image.reshape(stream.height, stream.width)
    return upright[::-1] if stream.rows_bottom_up else upright


@kernel
def _image(packed: UInt8, tick: int, image: Float32, start: int, stop: int) -> None:
    n = len(packed)
    for p in range(start, stop):
        before, after = find_spike(packed, p, tick - 1, -1), find_spike(packed, p, tick, 1)
        if before >= 0 and after >= 0:
            length = after - before
        elif after >= 0:
            following = find_spike(packed, p, after + 1, 1)
            length = n if following < 0 else max(following - after, after + 1)
        elif before >= 0:
            earlier = find_spike(packed, p, before - 1, -1)
            length = n if earlier < 0 else max(before - earlier, n - before)
        image[p] = np.float32(1) / np.float32(length) if before >= 0 or after >= 0 else np.float32(0)


def tfi_stack(stream: SpikeStream, out: Float32 | None = None) -> Float32:
    """Return `tfi_image` at every tick: spikes per tick [T, H, W] float32, in `out` if given. Clips of < 2^24 ticks."""
    if out is None:
        out = np.empty((stream.n_ticks, stream.height, stream.width), np.float32)
    blocks = (stream.packed.shape[1] + _BLOCK - 1) // _BLOCK
    arguments = (rows(stream.packed), lanes(1)[:, 0], stream.rows_bottom_up)
    in_threads(_stack, blocks, *arguments, out, small=out.size < 1 << 20)
    return out


@kernel
def _stack(packed: UInt8, table: UInt64, flip: bool, out: Float32, start: int, stop: int) -> None:
    """For each block of pixels, note the last spike before each tick forward in time, and divide backward in time."""
    n, height, width = out.shape
    words = np.empty(_BLOCK, np.uint64)
    rates = np.empty((n, 8 * _BLOCK), np.float32)  # first the time of the last spike, then 1 / interval
    for block in range(start, stop):
        first, end = block * _BLOCK, min((block + 1) * _BLOCK, packed.shape[1])
        size = min(8 * (end - first), height * width - 8 * first)
        fired = words.view(np.uint8)[:size]
        spike, other = np.full(size, -np.inf, np.float32), np.full(size, -np.inf, np.float32)
        for t in range(n):
            expand(packed[t, first:end], table, words)
            _note(fired, np.float32(t), spike, other, rates[t])
        _pass_end(n, spike, other)
        for t in range(n - 1, -1, -1):
            expand(packed[t, first:end], table, words)
            _divide(fired, np.float32(t), spike, other, rates[t])
        _fill_beginning(n, spike, other, rates)
        for t in range(n):
            _store(rates[t, :size], 8 * first, flip, out[t])


@kernel
def _note(fired: UInt8, t: np.float32, last: Float32, earlier: Float32, before: Float32) -> None:
    """Set before = last; where a pixel fired, (last, earlier) = (t, last)."""
    for p in range(len(fired)):
        i = np.uint64(p)
        a, b, c = last[i], earlier[i], fired[i] != 0
        before[i] = a
        earlier[i] = a if c else b
        last[i] = t if c else a


@kernel
def _pass_end(n: int, last: Float32, earlier: Float32) -> None:
    """Turn the last spike into the assumed first spike after the clip, and forget the one earlier."""
    for p in range(len(last)):
        if earlier[p] >= 0:
            last[p] += max(last[p] - earlier[p], n - last[p])
        elif last[p] >= 0:
            last[p] += n
        else:
            last[p] = np.inf
        earlier[p] = np.inf


@kernel
def _divide(fired: UInt8, t: np.float32, following: Float32, later: Float32, rates: Float32) -> None:
    """Set (following, later) = (t, following) where a pixel fired, then rates = 1 / (following - the spike before)."""
    for p in range(len(fired)):
        i = np.uint64(p)
        a, b, c = following[i], later[i], fired[i] != 0
        later[i] = a if c else b
        a = t if c else a
        following[i] = a
        rates[i] = np.float32(1) / (a - rates[i])


@kernel
def _fill_beginning(n: int, first: Float32, second: Float32, rates: Float32) -> None:
    """Set the rates of the ticks up to the first spike, which have no spike before them."""
    for p in range(len(first)):
        if first[p] < n:
            length = max(second[p] - first[p], first[p] + 1) if second[p] < n else np.float32(n)
            for t in range(int(first[p]) + 1):
                rates[t, p] = np.float32(1) / np.float32(length)


@kernel
def _store(values: Float32, first: int, flip: bool, image: Float32) -> None:
    """Write stored pixels [first, first + len(values)) into the image [H, W], whose rows are reversed if `flip`."""
    height, width = image.shape
    done = 0
    while done < len(values):
        r, x = divmod(first + done, width)
        size = min(width - x, len(values) - done)
        row = image[height - 1 - r if flip else r]
        for k in range(size):
            row[np.uint64(x + k)] = values[np.uint64(done + k)]
        done += size


TFI = ImageMaker(
    name="tfi",
    definition="1 / (the inter-spike interval that contains the start of tick t)",
    source="Zhu, Dong, Huang, Tian: A retina-inspired sampling method for visual texture reconstruction, ICME 2019",
    rate=lambda stream, tick, _: tfi_image(stream, tick),
    label="from spike intervals",
)
