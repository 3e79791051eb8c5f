"""Streams with gaps and bad pixels, against streams that never had any, and a float64 twin."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from memory import STATUS, resident_bytes

from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.repair import INTERVALS, NEAR_TICKS, fill_gaps, fill_pixels
from spike4dgs.benchmark.spikes.stream import SpikeStream, open_stream, pack

WIDTH, HEIGHT, TICKS = 21, 6, 400


def stream_of(spikes, gaps=(), bottom_up=True):
    lost = spikes.copy()
    for first, ticks in gaps:
        lost[first : first + ticks] = 0
    found = tuple(Gap("cam_00", first, ticks, "overflow") for first, ticks in gaps)
    return SpikeStream(pack(lost, bottom_up), WIDTH, HEIGHT, 20000.0, bottom_up, gaps=found)


def steady(rates, n_ticks=TICKS, seed=0):
    charge = np.random.default_rng(seed).random(rates.shape) + np.arange(n_ticks + 1)[:, None, None] * rates
    return np.diff(np.floor(charge), axis=0).astype(np.uint8)


RATES = np.linspace(0.02, 0.95, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)


def test_dropped_ticks_under_constant_light_cost_next_to_nothing():
    spikes, gaps = steady(RATES), [(t, 1) for t in range(7, TICKS - 2, 23)]
    filled = fill_gaps(stream_of(spikes, gaps))
    assert not filled.gaps
    lost = sum(int(spikes[t].sum()) for t, _ in gaps)
    before, after = (np.abs(s - spikes.sum(0)).mean() for s in (_counts(stream_of(spikes, gaps)), _counts(filled)))
    assert after < 0.1 * before and lost > 500
    wrong = np.abs(_counts(filled) - spikes.sum(0))
    assert wrong.max() <= 5, "of seventeen gaps"
    kept = np.ones(TICKS, bool)
    kept[[t for t, _ in gaps]] = False
    np.testing.assert_array_equal(filled.window(0, TICKS)[kept], spikes[kept])


def _counts(stream):
    return stream.counts(0, TICKS).astype(int)


def test_a_long_gap_goes_on_at_the_rate_and_remains_listed():
    spikes = steady(RATES)
    filled = fill_gaps(stream_of(spikes, [(100, 60), (200, 3)]))
    assert [(g.first_tick, g.ticks) for g in filled.gaps] == [(100, 60)]
    assert [(g.first_tick, g.ticks) for g in filled.filled] == [(100, 60), (200, 3)] and fill_gaps(filled).filled == (
        filled.filled
    )
    assert np.abs(_counts(filled) - spikes.sum(0)).max() <= 1 + 60 / NEAR_TICKS


@pytest.mark.parametrize("gap", [(0, 30), (370, 30), (0, 400)])
def test_gaps_at_the_ends_take_the_rate_beside_them(gap):
    spikes = steady(RATES)
    filled = fill_gaps(stream_of(spikes, [gap]))
    known = spikes.sum(0) if gap[1] < TICKS else 0
    assert np.abs(_counts(filled) - known).max() <= 1 + 2 * 30 / NEAR_TICKS


def _near(times):
    """Return the first time and those whose predecessor is near it, or among the first intervals."""
    last = [abs(t - times[0]) for t in times[:-1]]
    return times[:1] + [t for i, t in enumerate(times[1:]) if i < INTERVALS or last[i] < NEAR_TICKS]


def twin(fired, start, stop, limit):
    """Return the ticks that one pixel gets in a gap, in plain Python."""
    before = _near([t for t in range(start) if fired[t]][::-1])
    after = _near([t for t in range(stop, limit) if fired[t]])
    # The nearest spike after the gap counts only before the next gap, the ones before it always.
    intervals = max(len(before) - 1, 0) + max(len(after) - 1, 0)
    if not intervals:
        return []
    spans = [abs(side[-1] - side[0]) for side in (before, after) if side]
    length = sum(spans) / intervals
    p = q = None
    if before:
        p = np.mean([t + j * length for j, t in enumerate(before)])
        p = min(max(p, before[0] - 1), before[0] + 1)
    if after:
        q = np.mean([t - j * length for j, t in enumerate(after)])
        q = min(max(q, after[0] - 1), after[0] + 1)
    if p is not None and q is not None:
        lost = min(max(math.floor((q - p) / length + 0.5) - 1, 0), stop - start)
        out = []
        for k in range(1, lost + 1):
            tick = math.floor(p + k * (q - p) / (lost + 1) + 0.5)
            out.append(min(max(tick, (out[-1] if out else start - 1) + 1), stop - 1 - (lost - k)))
        return out
    silence = start - p if q is None else q - stop
    length = length if silence < 2 * length else silence
    places = [p + k * length for k in range(1, 2000)] if q is None else [q - k * length for k in range(1, 2000)]
    return sorted({t for t in (math.floor(x + 0.5) for x in places) if start <= t < stop})


@pytest.mark.parametrize("gaps", [[(50, 1), (53, 1), (120, 4)], [(0, 5), (60, 40)], [(300, 100)], [(10, 2), (12, 3)]])
def test_the_kernel_is_its_twin_on_random_spikes(gaps):
    rng = np.random.default_rng(len(gaps))
    spikes = (rng.random((TICKS, HEIGHT, WIDTH)) < rng.random((HEIGHT, WIDTH)) ** 2).astype(np.uint8)
    spikes[:, 0, 0], spikes[:, 0, 1], spikes[:, 0, 2] = 0, 1, 0
    spikes[[40, 333], 0, 2] = 1
    merged = [(10, 5)] if gaps[0] == (10, 2) else gaps
    expected = stream_of(spikes, gaps).window(0, TICKS).copy()
    for y in range(HEIGHT):
        for x in range(WIDTH):
            for i, (first, ticks) in enumerate(merged):
                limit = merged[i + 1][0] if i + 1 < len(merged) else TICKS
                expected[twin(expected[:, y, x], first, first + ticks, limit), y, x] = 1
    found = fill_gaps(stream_of(spikes, gaps)).window(0, TICKS)
    assert (found != expected).any(axis=0).mean() <= 0.01, "an exact half may round to either side"


def test_a_stream_without_gaps_is_itself():
    stream = stream_of(steady(RATES))
    assert fill_gaps(stream) is stream and fill_pixels(stream, None) is stream
    assert fill_pixels(stream, np.zeros((HEIGHT, WIDTH), bool)) is stream


@pytest.mark.parametrize("bottom_up", [True, False])
def test_a_bad_pixel_fires_as_its_neighbour(bottom_up):
    spikes = steady(RATES)
    bad = np.zeros((HEIGHT, WIDTH), bool)
    bad[2, 3] = bad[2, 4] = bad[5, 20] = True
    stream = stream_of(np.where(bad, 1, spikes).astype(np.uint8), bottom_up=bottom_up)
    stream = replace(stream, packed=stream.packed.copy())
    stream.packed.flags.writeable = False
    found = fill_pixels(stream, bad).window(0, TICKS)
    np.testing.assert_array_equal(found[:, ~bad], spikes[:, ~bad])
    for y, x in np.argwhere(bad):
        near = [(a, b) for a in range(y - 1, y + 2) for b in range(x - 1, x + 2) if 0 <= a < HEIGHT and 0 <= b < WIDTH]
        assert any((found[:, y, x] == spikes[:, a, b]).all() for a, b in near if not bad[a, b])


def test_gaps_of_a_mapped_file_are_filled_next_to_it(tmp_path):
    """The file stays as it is, and of its pages the few that change are in memory."""
    width, height, ticks = 256, 128, 4000  # a page a tick
    gaps = tuple(Gap("cam_00", first, 2, "overflow") for first in range(100, 3900, 400))
    path = tmp_path / "lost.dat"
    path.write_bytes(np.random.default_rng(0).bytes(ticks * width * height // 8))
    stream = open_stream(path, width, height, 20000.0, gaps=gaps)
    in_memory = replace(stream, packed=np.array(stream.packed))
    expected, content = fill_gaps(in_memory).packed, path.read_bytes()
    before = resident_bytes("RssAnon") if STATUS.is_file() else 0
    filled = fill_gaps(stream)
    if STATUS.is_file():
        assert resident_bytes("RssAnon") - before < len(content) / 4
    filled.release()
    np.testing.assert_array_equal(filled.packed, expected)
    assert path.read_bytes() == content and (filled.packed[100] != stream.packed[100]).any()
    part = replace(stream, packed=stream.packed[50:], gaps=(replace(gaps[0], first_tick=50),))
    expected = fill_gaps(replace(part, packed=np.array(part.packed))).packed
    np.testing.assert_array_equal(fill_gaps(part).packed, expected, err_msg="a part of a file's ticks")
