"""Spike trains and spans between spikes against plain loops, and the memory that trains take."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from memory import peak_bytes

from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.lost_spikes import doubtful_between
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.benchmark.spikes.times import is_recorded, spans_around
from spike4dgs.benchmark.spikes.trains import count_before, first_from, last_before, spike_trains, trains_bytes


def stream_of(spikes: np.ndarray) -> SpikeStream:
    return SpikeStream(pack(spikes, rows_bottom_up=False), spikes.shape[2], spikes.shape[1], 20_000.0, False)


@settings(max_examples=40, deadline=None)
@example(128, 8, 0.5, 0)
@example(1, 1, 1.0, 0)
@given(st.integers(1, 700), st.integers(1, 21), st.sampled_from([0.0, 0.003, 0.3, 1.0]), st.integers(0, 2**31))
def test_numbers_and_ticks_of_spikes_are_those_of_a_plain_loop(n: int, width: int, rate: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    spikes = rng.random((n, 1, width)) < rate
    trains = spike_trains(stream_of(spikes))
    for pixel in range(width):
        fired = np.flatnonzero(spikes[:, 0, pixel])
        for tick in {0, n, *rng.integers(0, n + 1, 20).tolist(), *range(0, n + 1, 64)}:
            before, after = fired[fired < tick], fired[fired >= tick]
            assert count_before(trains.words, trains.before, pixel, tick) == len(before)
            if len(before):
                assert last_before(trains.words, pixel, tick) == before[-1]
            if len(after):
                assert first_from(trains.words, pixel, tick) == after[0]


@settings(max_examples=30, deadline=None)
@example(64, 1.0, 0)
@given(st.integers(1, 300), st.sampled_from([0.0, 0.05, 0.5, 1.0]), st.integers(0, 2**31))
def test_certain_spikes_and_those_in_doubt_are_apart(n: int, share: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    spikes, lost = rng.random((n, 1, 9)) < 0.3, rng.random(n) < share
    doubt = lost[:, None, None] & (rng.random((n, 1, 9)) < (0.5 if seed % 2 else 2))
    gaps = tuple(Gap("c", int(t), 1, "lost") for t in np.flatnonzero(lost))
    sure = pack(~doubt[lost], rows_bottom_up=False) if seed % 2 else None
    trains = spike_trains(replace(stream_of(spikes), filled=gaps, certain=sure))
    np.testing.assert_array_equal(trains.lost, np.concatenate([[0], np.cumsum(lost)]))
    for pixel in range(9):
        own = doubt[:, 0, pixel]
        for a, b in np.sort(rng.integers(0, n + 1, (8, 2)), axis=1).tolist():
            certain = [count_before(trains.words, trains.before, pixel, t) for t in (a, b)]
            assert certain[1] - certain[0] == (spikes[a:b, 0, pixel] & ~own[a:b]).sum()
            found = doubtful_between(trains.lost, trains.doubt_words, trains.doubt_before, pixel, a, b)
            assert found == (own[a:b].sum(), (spikes[a:b, 0, pixel] & own[a:b]).sum())


def test_padding_bits_of_the_last_byte_are_no_pixels() -> None:
    spikes = np.random.default_rng(0).random((100, 3, 3)) < 0.4
    stream = stream_of(spikes)
    stream.packed[:, -1] |= 0b11111110  # nine pixels: seven bits are nobody's
    trains = spike_trains(stream)
    found = [count_before(trains.words, trains.before, pixel, 100) for pixel in range(9)]
    assert found == spikes.sum(axis=0).reshape(-1).tolist()


@pytest.mark.parametrize("rate", [0.0, 0.9])
def test_trains_take_little_more_than_the_stream_whatever_it_holds(rate: float) -> None:
    stream = stream_of(np.random.default_rng(0).random((6400, 16, 16)) < rate)
    spike_trains(stream_of(np.zeros((1, 1, 1))))  # compiles, and what is cached is small
    assert trains_bytes(stream) < 1.2 * stream.packed.nbytes
    assert peak_bytes(lambda: spike_trains(stream)) < trains_bytes(stream) + 100_000


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
