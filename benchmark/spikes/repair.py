"""Streams without holes: missing ticks are filled from the spikes around them, bad pixels from a neighbour's spikes.

Every consumer of a stream then works as it is, whatever it counts. What is filled says nothing new: a loss leaves bad
pixels out (`CameraState.bad`), and the gaps that remain listed, which are long. Who looks at single spikes leaves out
all that is filled where a spike's own tick matters (`lost_spikes`).

Lost ticks between the same two recorded spikes of a pixel are filled together. On either side of them the spikes as far
as NEAR_TICKS tell the usual interval L, as long as they are even: as long as one interval explains them all to EVEN
ticks. So light that changes is judged by the nearest spikes alone. On that train the two recorded spikes have the
places P and Q. A lost spike lies in a lost tick. So m lost spikes misfit by

    (Q - P - (m + 1) L)^2    their number, and
    (t - e)^2                each of them, by the distance of its lost tick t from its even place e between P and Q,

each divided by its variance, which the difference of the two sides' intervals says. The m of the least misfit is
filled. That is done twice: the second time with what was filled beyond. Then a few lost ticks hold what `likely_spikes`
finds, and where that is certain they are as good as recorded.
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
from spike4dgs.benchmark.spikes.likely_spikes import MOST, likely_spikes
from spike4dgs.benchmark.spikes.stream import SpikeStream

LONGEST_TICKS = 10  # of a gap whose ticks count as measured once it is filled: a quarter of the windows of 40 ticks
NEAR_TICKS = 20  # on each side of a gap whose intervals count: as far as most image makers look
EVEN = 0.65  # ticks that even spikes may be off; a tick hides up to one, but light that changes then goes unseen
FAR_EVEN = 1.0  # beside more than LONGEST_TICKS lost ticks, where a steady rate matters more
HIDDEN = 0.25  # of a tick that an even place may lie off its lost tick at no cost
LONE = 0.3  # of an interval: how far intervals may differ where one side alone is known
STEADY = 0.05  # of an interval: how far they may differ in any case
TIE = 1e-9  # a difference below it is none: the first of two counts, however sums were rounded
PLACE, LENGTH = 0.05, 0.1  # ticks^2: variance of a lost spike's place, and of Q - P
_SMALL = 1 << 16  # pixels times gaps below which starting threads costs more than it saves

AnyRecording = TypeVar("AnyRecording", SpikeStream, CountedRecording, Recording)


def fill_gaps(stream: SpikeStream) -> SpikeStream:
    """Return the stream with its missing ticks filled, and listed in `filled`; `certain` tells where that is certain.

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
    lost = np.flatnonzero(~there)
    certain = np.zeros((len(lost), packed.shape[1]), np.uint8)
    in_threads(_fill, packed.shape[1], plain, starts, stops, lost, pixels, certain, small=pixels * len(starts) < _SMALL)
    long = [(a, b) for a, b in zip(starts, stops, strict=True) if b - a > LONGEST_TICKS]
    gaps = tuple(g for g in stream.gaps if any(a <= g.first_tick < b for a, b in long))
    filled = tuple(sorted({*stream.filled, *stream.gaps}))
    if stream.filled:  # gaps that were filled before
        ticks = np.flatnonzero(~present(filled, stream.n_ticks))
        merged = np.zeros((len(ticks), packed.shape[1]), np.uint8)
        if stream.certain is not None:
            earlier = np.flatnonzero(~present(stream.filled, stream.n_ticks))
            merged[np.searchsorted(ticks, earlier)] = stream.certain
        merged[np.searchsorted(ticks, lost)] = certain
        certain = merged
    return replace(stream, packed=packed, gaps=gaps, filled=filled, certain=certain)


def _private(packed: UInt8) -> UInt8:
    """Return ticks that can be written to without a change of `packed` or its file."""
    whole = isinstance(packed.base, mmap.mmap)  # a part of a map keeps the offset of the whole
    if whole and isinstance(packed, np.memmap) and packed.filename and not packed.flags.writeable:
        return np.memmap(packed.filename, np.uint8, "c", packed.offset, packed.shape)
    return np.array(packed)


@kernel
def _fill(
    packed: UInt8, starts: Int64, stops: Int64, lost: Int64, pixels: int, certain: UInt8, start: int, stop: int
) -> None:
    for pixel in range(8 * start, min(8 * stop, pixels)):
        for known in range(2):  # what lost ticks beyond hold
            first, n = 0, 0
            while first < len(starts):
                last, ticks = first, n + stops[first] - starts[first]
                _clear(packed, pixel, starts[first], stops[first])
                after = find_spike(packed, pixel, stops[last], 1)
                while last + 1 < len(starts) and (after < 0 or after >= starts[last + 1]):
                    last += 1  # no recorded spike lies between
                    ticks += stops[last] - starts[last]
                    _clear(packed, pixel, starts[last], stops[last])
                    if after >= 0 and after < stops[last]:
                        after = find_spike(packed, pixel, stops[last], 1)
                before = find_spike(packed, pixel, starts[first] - 1, -1)
                limit = len(packed) if known or last + 1 == len(starts) else starts[last + 1]
                if before >= 0 and after >= 0:
                    _fill_between(packed, pixel, before, after, lost[n:ticks], limit)
                    if known and ticks - n <= MOST:
                        _fill_likely(packed, pixel, before, after, lost[n:ticks], certain[n:ticks])
                elif before >= 0:
                    for g in range(first, last + 1):
                        _go_on(packed, pixel, starts[g], stops[g], 1, limit)
                elif after >= 0:
                    for g in range(last, first - 1, -1):
                        _go_on(packed, pixel, starts[g], stops[g], -1, limit)
                first, n = last + 1, ticks


@kernel
def _clear(packed: UInt8, pixel: int, start: int, stop: int) -> None:
    for tick in range(start, stop):
        packed[tick, pixel >> 3] &= np.uint8(~(1 << (pixel & 7)) & 255)


@kernel
def _set(packed: UInt8, pixel: int, tick: int) -> None:
    packed[tick, pixel >> 3] |= np.uint8(1 << (pixel & 7))


@kernel
def _fill_likely(packed: UInt8, pixel: int, before: int, after: int, lost: Int64, certain: UInt8) -> None:
    """Fill a few lost ticks between two recorded spikes with what is likely, and set where that is certain."""
    likely, sure = likely_spikes(packed, pixel, before, after, lost)
    if likely < 0:
        return
    for d in range(len(lost)):
        _clear(packed, pixel, lost[d], lost[d] + 1)
        if likely >> d & 1:
            _set(packed, pixel, lost[d])
        if sure >> d & 1:
            _set(certain, pixel, d)


@kernel
def _fill_between(packed: UInt8, pixel: int, before: int, after: int, lost: Int64, limit: int) -> None:
    """Fill the lost ticks between two recorded spikes. All ticks before them are known, those after up to `limit`."""
    even = EVEN if len(lost) <= LONGEST_TICKS else FAR_EVEN
    n_before, span_before, sum_before, low_before, high_before = _train(packed, pixel, before, -1, limit, even)
    n_after, span_after, sum_after, low_after, high_after = _train(packed, pixel, after, 1, limit, even)
    if n_before + n_after == 0:
        return  # hardly any light: nothing tells that a spike was lost
    length = (span_before + span_after) / (n_before + n_after)
    left = right = length
    change = LONE * length
    if n_before > 0 and n_after > 0:
        change = (span_after / n_after - span_before / n_before) / 2
        if max(low_before, low_after) > min(high_before, high_after):  # no one interval explains both sides
            left, right = span_before / n_before, span_after / n_after
            length = (left + right) / 2
    p = before + _shift(sum_before, n_before, left)
    q = after - _shift(sum_after, n_after, right)
    guess = int(np.floor((q - p) / length + TIE)) - 1
    best, least = 0, np.inf  # none where the lost ticks hold too few: the light was lower between
    for m in range(max(guess - 1, 0), min(max(guess, 0) + 2, len(lost)) + 1):
        misfit = _misfit(p, q, m, length, change, lost)
        if misfit < least - TIE:
            best, least = m, misfit
    j = -1
    for i in range(1, best + 1):
        j = _nearest(lost, j + 1, len(lost) - best + i, p + (q - p) * i / (best + 1))
        _set(packed, pixel, lost[j])


@kernel
def _misfit(p: float, q: float, m: int, length: float, change: float, lost: Int64) -> float:
    """Return minus the log likelihood of m lost spikes, but for a constant."""
    variance = LENGTH + ((m + 1) * STEADY * length) ** 2 + (m + 1) * change**2
    misfit = (q - p - (m + 1) * length) ** 2 / (2 * variance) + np.log(variance) / 2
    variance = PLACE + (STEADY * length) ** 2 + change**2 / 4
    j = -1
    for i in range(1, m + 1):
        even = p + (q - p) * i / (m + 1)
        j = _nearest(lost, j + 1, len(lost) - m + i, even)
        misfit += max(abs(lost[j] - even) - HIDDEN, 0.0) ** 2 / (2 * variance)
    return float(misfit)


@kernel
def _nearest(lost: Int64, start: int, stop: int, place: float) -> int:
    """Return which of lost[start:stop] is nearest to a place, the first of two."""
    j = start
    while j + 1 < stop and abs(lost[j + 1] - place) < abs(lost[j] - place) - TIE:
        j += 1
    return j


@kernel
def _go_on(packed: UInt8, pixel: int, start: int, stop: int, step: int, limit: int) -> None:
    """Fill a gap [start, stop) from the spikes on one side, as they go on in direction `step`."""
    first = find_spike(packed, pixel, start - 1 if step > 0 else stop, -step)
    even = EVEN if stop - start <= LONGEST_TICKS else FAR_EVEN
    n, span, total, _, _ = _train(packed, pixel, first, -step, limit, even)
    if n == 0:
        return
    length = span / n
    place = first + step * _shift(total, n, length)
    silence = start - place if step > 0 else place - (stop - 1)
    if silence >= 2 * length - TIE:
        length = silence
    tick = int(np.floor(place + step * length + 0.5 + TIE))
    while tick < stop if step > 0 else tick >= start:
        if start <= tick < stop:
            _set(packed, pixel, tick)
        place += step * length
        tick = int(np.floor(place + step * length + 0.5 + TIE))


@kernel
def _train(
    packed: UInt8, pixel: int, first: int, step: int, limit: int, even: float
) -> tuple[int, int, int, float, float]:
    """Return the even intervals beyond a spike in direction `step`.

    That is their number, their ticks, the sum of their ends' distances, and the least and the greatest one interval
    that explains them all.
    """
    n, total, at, low, high = 0, 0, first, 0.0, np.inf
    while abs(at - first) < NEAR_TICKS:
        following = find_spike(packed, pixel, at + step, step)
        if following < 0 or following >= limit:
            break
        distance = abs(following - first)
        lower, higher = max(low, (distance - even) / (n + 1)), min(high, (distance + even) / (n + 1))
        if lower > higher:
            break
        n, at, low, high = n + 1, following, lower, higher
        total += distance
    return n, abs(at - first), total, low, high


@kernel
def _shift(total: int, n: int, length: float) -> float:
    """Return how far a spike's place on an even train lies from its tick, towards the gap; at most a tick."""
    even = length * n * (n + 1) / 2
    return min(max((even - total) / (n + 1), -1.0), 1.0)


def fill_pixels(stream: AnyRecording, bad: Mask | None) -> AnyRecording:
    """Return the stream, in memory, whose pixels of a mask [H, W] fire as their nearest pixel outside of it does.

    They are as certain as that pixel is. Of a counted recording the counts are those of that pixel.
    """
    if bad is None or not bad.any() or bad.all():
        return stream
    from scipy.ndimage import distance_transform_edt  # where it is used: scenes open without it

    rows, columns = distance_transform_edt(bad, return_distances=False, return_indices=True)
    if isinstance(stream, CountedRecording):
        return stream.taken(rows, columns)
    packed, certain = np.array(stream.packed), None if stream.certain is None else np.array(stream.certain)
    for y, x in np.argwhere(bad):
        target, source = _stored(stream, y, x), _stored(stream, rows[y, x], columns[y, x])
        for bits in (packed,) if certain is None else (packed, certain):
            own = bits[:, source >> 3] >> (source & 7) & 1
            bits[:, target >> 3] = bits[:, target >> 3] & ~np.uint8(1 << (target & 7)) | own << (target & 7)
    return replace(stream, packed=packed, certain=certain)


def _stored(stream: SpikeStream, y: int, x: int) -> int:
    return int((stream.height - 1 - y if stream.rows_bottom_up else y) * stream.width + x)
