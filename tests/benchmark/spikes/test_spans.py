from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.benchmark.spikes.times import is_recorded, spans_around


def plain_spans(spikes: np.ndarray, lowest: int, highest: int, start: int, stop: int) -> np.ndarray:
    """Return first, last and intervals [3, H, W] by a loop over the pixels; zeros where an end is missing."""
    found = np.zeros((3, *spikes.shape[1:]), int)
    for index in np.ndindex(*spikes.shape[1:]):
        ticks = [t for t in range(lowest, highest) if spikes[(t, *index)]]
        before, after = [t for t in ticks if t <= start], [t for t in ticks if t >= stop - 1]
        if before and after:
            first, last = before[-1], after[0]
            found[(slice(None), *index)] = first, last, sum(first < t <= last for t in ticks)
    return found


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(8, 3), (5, 4)]), st.booleans(), st.floats(0.01, 0.9))
def test_spans_are_those_of_a_plain_loop(seed: int, size: tuple[int, int], bottom_up: bool, rate: float) -> None:
    rng, (width, height) = np.random.default_rng(seed), size
    spikes = rng.random((60, height, width)) < rate
    gaps = (Gap("c", 5, 3, "lost"), Gap("c", 50, 4, "lost")) if seed % 2 else ()
    for gap in gaps:
        spikes[gap.first_tick : gap.stop_tick] = rng.random((gap.ticks, height, width)) < 0.5  # no measurement
    stream = SpikeStream(pack(spikes, bottom_up), width, height, 2e4, bottom_up, gaps=gaps)
    lowest, highest = (8, 50) if gaps else (0, 60)
    start = int(rng.integers(lowest, highest - 2))
    stop = int(rng.integers(start + 2, highest + 1))
    found = spans_around(stream, start, stop)
    expected = plain_spans(spikes, lowest, highest, start, stop)
    np.testing.assert_array_equal(found.intervals, expected[2])
    there = expected[2] > 0
    np.testing.assert_array_equal(found.first[there], expected[0][there])
    np.testing.assert_array_equal(found.last[there], expected[1][there])


def test_windows_outside_the_clip_or_in_a_gap_are_not_recorded() -> None:
    stream = SpikeStream(np.zeros((20, 1), np.uint8), 8, 1, 2e4, gaps=(Gap("c", 10, 2, "lost"),))
    inside = [(0, 10), (12, 20), (0, 1)]
    outside = [(-1, 5), (15, 21), (9, 11), (11, 12), (8, 14), (5, 5)]
    assert all(is_recorded(stream, *ticks) for ticks in inside)
    assert not any(is_recorded(stream, *ticks) for ticks in outside)
