"""Streams without holes: missing ticks are filled from the spikes around them, bad pixels from a neighbour's spikes.

Every consumer of a stream then works as it is, whatever it counts. What is filled says nothing new: a loss leaves bad
pixels out (`CameraState.bad`), and the gaps that remain listed, which are long. Who looks at single spikes leaves out
all that is filled where a spike's own tick matters (`lost_spikes`).

A pixel's intervals within NEAR_TICKS on either side of a gap, two at least, give its usual interval L, and on an even
train the places p and q of the last spike before the gap and the first after it. round((q - p) / L) - 1 spikes were
lost; they are put at even distances. Under constant light that restores the count, but for what the tick hides of a
spike's place.
"""

from __future__ import annotations

import mmap
from dataclasses import replace
from typing import TypeVar

import numpy as np

from spike4dgs.benchmark.arrays import Int64, Mask, UInt8
from spike4dgs.benchmark.spikes.bits import find_spike, in_threads, kernel
from spike4dgs.benchmark.spikes.counted_recording import CountedRecording, Recording
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream

LONGEST_TICKS = 10  # of a gap whose ticks count as measured once it is filled: a quarter of the windows of 40 ticks
NEAR_TICKS = 20  # on each side of a gap whose intervals count: as far as most image makers look
INTERVALS = 2  # that count in any case, if there are so many
_SMALL = 1 << 16  # pixels times gaps below which starting threads costs more than it saves

AnyRecording = TypeVar("AnyRecording", SpikeStream, CountedRecording, Recording)


def fill_gaps(stream: SpikeStream) -> SpikeStream:
    """Return the stream with its missing ticks filled, and listed in `filled`.

    Gaps longer than LONGEST_TICKS remain listed in `gaps` too. Of a mapped file the pages that change are in memory,
    and no others.
    """
    if not stream.gaps:
        return stream
    there = present(stream.gaps, stream.n_ticks)
    edges = np.diff(np.concatenate([[1], there.astype(np.int8), [1]]))
    starts, stops = np.nonzero(edges < 0)[0], np.nonzero(edges > 0)[0]  # gaps that touch are one
    packed, pixels = _private(stream.packed), stream.width * stream.height
    packed[~there] = 0
    plain = packed.view(np.ndarray)
    in_threads(_fill, packed.shape[1], plain, starts, stops, pixels, small=pixels * len(starts) < _SMALL)
    long = [(a, b) for a, b in zip(starts, stops, strict=True) if b - a > LONGEST_TICKS]
    gaps = tuple(g for g in stream.gaps if any(a <= g.first_tick < b for a, b in long))
    filled = tuple(sorted({*stream.filled, *stream.gaps}))
    return replace(stream, packed=packed, gaps=gaps, filled=filled)


def _private(packed: UInt8) -> UInt8:
    """Return ticks that can be written to without a change of `packed` or its file."""
    whole = isinstance(packed.base, mmap.mmap)  # a part of a map keeps the offset of the whole
    if whole and isinstance(packed, np.memmap) and packed.filename and not packed.flags.writeable:
        return np.memmap(packed.filename, np.uint8, "c", packed.offset, packed.shape)
    return np.array(packed)


@kernel
def _fill(packed: UInt8, starts: Int64, stops: Int64, pixels: int, start: int, stop: int) -> None:
    for pixel in range(8 * start, min(8 * stop, pixels)):
        for g in range(len(starts)):
            limit = starts[g + 1] if g + 1 < len(starts) else len(packed)
            _fill_one(packed, pixel, starts[g], stops[g], limit)


@kernel
def _fill_one(packed: UInt8, pixel: int, start: int, stop: int, limit: int) -> None:
    """Fill the gap [start, stop) of one stored pixel. All ticks before it are known, those after it up to `limit`."""
    before, after = find_spike(packed, pixel, start - 1, -1), find_spike(packed, pixel, stop, 1)
    if after >= limit:
        after = -1
    n_before, span_before, sum_before = _train(packed, pixel, before, -1, limit)
    n_after, span_after, sum_after = _train(packed, pixel, after, 1, limit)
    if n_before + n_after == 0:
        return  # hardly any light: nothing tells that a spike was lost
    length = (span_before + span_after) / (n_before + n_after)
    p = before + _shift(sum_before, n_before, length)
    q = after - _shift(sum_after, n_after, length)
    if before >= 0 and after >= 0:
        lost = min(max(int(np.floor((q - p) / length + 0.5)) - 1, 0), stop - start)
        step = (q - p) / (lost + 1)
    else:
        silence = start - p if before >= 0 else q - stop
        lost, step = stop - start, length if silence < 2 * length else silence
        if before < 0:
            lost = int((q - start + 0.5) / step)
            p = q - (lost + 1) * step
    last = start - 1
    for k in range(1, lost + 1):
        tick = int(np.floor(p + k * step + 0.5))
        if after >= 0 and before >= 0:
            tick = min(max(tick, last + 1), stop - 1 - (lost - k))
        if tick >= stop:
            break
        if tick > last:
            packed[tick, pixel >> 3] |= np.uint8(1 << (pixel & 7))
            last = tick


@kernel
def _train(packed: UInt8, pixel: int, first: int, step: int, limit: int) -> tuple[int, int, int]:
    """Return the intervals beyond a spike in direction `step`, their ticks, and the sum of their ends' distances."""
    n, total, at = 0, 0, first
    while at >= 0 and (n < INTERVALS or abs(at - first) < NEAR_TICKS):
        following = find_spike(packed, pixel, at + step, step)
        if following < 0 or following >= limit:
            break
        n, at = n + 1, following
        total += abs(at - first)
    return n, abs(at - first), total


@kernel
def _shift(total: int, n: int, length: float) -> float:
    """Return how far a spike's place on an even train lies from its tick, towards the gap; at most a tick."""
    even = length * n * (n + 1) / 2
    return min(max((even - total) / (n + 1), -1.0), 1.0)


def fill_pixels(stream: AnyRecording, bad: Mask | None) -> AnyRecording:
    """Return the stream, in memory, whose pixels of a mask [H, W] fire as their nearest pixel outside of it does.

    Of a counted recording the counts are those of that pixel.
    """
    if bad is None or not bad.any() or bad.all():
        return stream
    from scipy.ndimage import distance_transform_edt  # where it is used: scenes open without it

    rows, columns = distance_transform_edt(bad, return_distances=False, return_indices=True)
    if isinstance(stream, CountedRecording):
        return stream.taken(rows, columns)
    packed = np.array(stream.packed)
    for y, x in np.argwhere(bad):
        target, source = _stored(stream, y, x), _stored(stream, rows[y, x], columns[y, x])
        spikes = packed[:, source >> 3] >> (source & 7) & 1
        packed[:, target >> 3] = packed[:, target >> 3] & ~np.uint8(1 << (target & 7)) | spikes << (target & 7)
    return replace(stream, packed=packed)


def _stored(stream: SpikeStream, y: int, x: int) -> int:
    return int((stream.height - 1 - y if stream.rows_bottom_up else y) * stream.width + x)
