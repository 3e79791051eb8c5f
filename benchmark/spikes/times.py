"""The intervals that a camera recorded around a few ticks: each pixel's from its last spike before to its first after.

A span holds one or more intervals between spikes. It says how long the pixel took for so many charges, whatever charge
it held when the window began; a count over the window does not know that charge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Int32
from spike4dgs.benchmark.spikes.bits import kernel, rows
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream


@dataclass(frozen=True, eq=False)
class Spans:
    """Spans of every pixel [H, W]: ticks of the first and the last spike, and the intervals between them.

    `intervals` is 0 where the recording has no spike before the window or none after it.
    """

    first: Int32
    last: Int32
    intervals: Int32


def is_recorded(stream: SpikeStream, start: int, stop: int) -> bool:
    """Return whether ticks [start, stop) lie within the clip and outside its gaps."""
    inside = 0 <= start < stop <= stream.n_ticks
    return inside and all(gap.stop_tick <= start or gap.first_tick >= stop for gap in stream.gaps)


def spans_around(stream: SpikeStream, start: int, stop: int) -> Spans:
    """Return each pixel's span: from its last spike at or before tick `start` to its first at or after `stop` - 1.

    No span reaches over a gap. The ticks [start, stop), two or more, must be recorded.
    """
    known = present(stream.gaps, stream.n_ticks)
    before, after = np.flatnonzero(~known[:start]), np.flatnonzero(~known[stop:])
    lowest = int(before[-1]) + 1 if len(before) else 0
    highest = stop + int(after[0]) if len(after) else stream.n_ticks
    n = stream.width * stream.height
    first, last, intervals = (np.zeros(n, np.int32) for _ in range(3))
    _find_spans(rows(stream.packed[lowest:highest]), start - lowest, stop - 1 - lowest, first, last, intervals)
    found = [x.reshape(stream.height, stream.width) for x in (first + lowest, last + lowest, intervals)]
    return Spans(*(x[::-1] if stream.rows_bottom_up else x for x in found))


@kernel
def _find_spans(packed: Any, start: Any, stop: Any, first: Any, last: Any, intervals: Any) -> None:
    """Fill the spans of all pixels [P], from packed rows [T, bytes]; intervals stay 0 where an end is missing."""
    for pixel in range(len(first)):
        byte, bit = pixel >> 3, np.uint8(1 << (pixel & 7))
        a = start
        while a >= 0 and not packed[a, byte] & bit:
            a -= 1
        if a < 0:
            continue
        b, count = a, 0
        for tick in range(a + 1, len(packed)):
            if packed[tick, byte] & bit:
                b, count = tick, count + 1
                if tick >= stop:
                    break
        if count > 0 and b >= stop:
            first[pixel], last[pixel], intervals[pixel] = a, b, count
