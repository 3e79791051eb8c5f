"""Streams with gaps and bad pixels, against streams that never had any, and a float64 twin."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from memory import STATUS, resident_bytes
from slow_likely import slow_likely

from spike4dgs.benchmark.spikes import repair
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.likely_spikes import MOST
from spike4dgs.benchmark.spikes.stream import SpikeStream, open_stream, pack

WIDTH, HEIGHT, TICKS = 21, 6, 400


def stream_of(spikes, gaps=(), bottom_up=True):
    lost = spikes.copy()
    for first, ticks in gaps:
        lost[first : first + ticks] = 0
    found = tuple(Gap("cam_00", first, ticks, "overflow") for first, ticks in gaps)
    return SpikeStream(pack(lost, bottom_up), WIDTH, lost.shape[1], 20000.0, bottom_up, gaps=found)


def steady(rates, n_ticks=TICKS, seed=0):
    charge = np.random.default_rng(seed).random(rates.shape) + np.arange(n_ticks + 1)[:, None, None] * rates
    return np.diff(np.floor(charge), axis=0).astype(np.uint8)


RATES = np.linspace(0.02, 0.95, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)


def test_dropped_ticks_under_constant_light_cost_next_to_nothing():
    spikes, gaps = steady(RATES), [(t, 1) for t in range(7, TICKS - 2, 23)]
    filled = repair.fill_gaps(stream_of(spikes, gaps))
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
    filled = repair.fill_gaps(stream_of(spikes, [(100, 60), (200, 3)]))
    assert [(g.first_tick, g.ticks) for g in filled.gaps] == [(100, 60)]
    assert [(g.first_tick, g.ticks) for g in filled.filled] == [(100, 60), (200, 3)]
    assert repair.fill_gaps(filled).filled == filled.filled
    assert np.abs(_counts(filled) - spikes.sum(0)).max() <= 1 + 60 / repair.NEAR_TICKS
    assert not filled.certain[:60].any() and filled.certain[60:].any(), "what a long gap held is never certain"
    np.testing.assert_array_equal(repair.fill_gaps(filled).certain, filled.certain)


@pytest.mark.parametrize("gap", [(0, 30), (370, 30), (0, 400)])
def test_gaps_at_the_ends_take_the_rate_beside_them(gap):
    spikes = steady(RATES)
    filled = repair.fill_gaps(stream_of(spikes, [gap]))
    known = spikes.sum(0) if gap[1] < TICKS else 0
    assert np.abs(_counts(filled) - known).max() <= 1 + 2 * 30 / repair.NEAR_TICKS


def test_a_gap_at_the_start_is_filled_as_one_at_the_end_of_the_reversed_stream():
    spikes = np.zeros((32, HEIGHT, WIDTH), np.uint8)
    spikes[:11] = 1
    ends, begins = (repair.fill_gaps(stream_of(s, [gap])) for s, gap in ((spikes, (12, 20)), (spikes[::-1], (0, 20))))
    assert ends.window(12, 32)[:, 0, 0].tolist() == [1, 0] * 10, "the silent tick before the gap tells the interval"
    np.testing.assert_array_equal(begins.window(0, 32), ends.window(0, 32)[::-1])


def even_train(times, lost):
    """Return the times that even spikes explain, away from the gap, and the bounds of their interval."""
    even = repair.EVEN if lost <= repair.LONGEST_TICKS else repair.FAR_EVEN
    kept, bounds = times[:1], (0.0, math.inf)
    for n, t in enumerate(times[1:], 1):
        distance = abs(t - times[0])
        bounds_n = max(bounds[0], (distance - even) / n), min(bounds[1], (distance + even) / n)
        if abs(kept[-1] - times[0]) >= repair.NEAR_TICKS or bounds_n[0] > bounds_n[1]:
            break
        kept, bounds = [*kept, t], bounds_n
    return kept, bounds


def place(times, length):
    """Return where the first of even spikes lies, by the mean of all."""
    sign = 1 if len(times) < 2 or times[1] < times[0] else -1
    return min(max(np.mean([t + sign * j * length for j, t in enumerate(times)]), times[0] - 1), times[0] + 1)


def nearest_places(lost, evens):
    """Return each spike's lost tick: the nearest that is left, with one for each that follows."""
    out, free = [], list(lost)
    for i, e in enumerate(evens):
        near = free[: len(free) - (len(evens) - i - 1)]
        tick = next(t for t in near if abs(t - e) <= min(abs(u - e) for u in near) + repair.TIE)
        out, free = [*out, tick], [t for t in free if t > tick]
    return out


def between(before, after, lost):
    """Return the ticks that a pixel gets in ticks lost between two spikes, in plain Python; trains away from them."""
    (before, low), (after, high) = even_train(before, len(lost)), even_train(after, len(lost))
    n = len(before) + len(after) - 2
    if n == 0:
        return []
    length = (before[0] - before[-1] + after[-1] - after[0]) / n
    left = right = length
    change = repair.LONE * length
    if len(before) > 1 and len(after) > 1:
        sides = (before[0] - before[-1]) / (len(before) - 1), (after[-1] - after[0]) / (len(after) - 1)
        change = (sides[1] - sides[0]) / 2
        if max(low[0], high[0]) > min(low[1], high[1]):
            (left, right), length = sides, sum(sides) / 2
    p, q = place(before, left), place(after, right)
    guess = math.floor((q - p) / length + repair.TIE) - 1
    found = [(math.inf, [])]
    for m in range(max(guess - 1, 0), min(max(guess, 0) + 2, len(lost)) + 1):
        evens = [p + (q - p) * i / (m + 1) for i in range(1, m + 1)]
        ticks = nearest_places(lost, evens)
        variance = repair.LENGTH + ((m + 1) * repair.STEADY * length) ** 2 + (m + 1) * change**2
        own = repair.PLACE + (repair.STEADY * length) ** 2 + change**2 / 4
        misfit = (q - p - (m + 1) * length) ** 2 / (2 * variance) + math.log(variance) / 2
        off = [max(abs(t - e) - repair.HIDDEN, 0) ** 2 / (2 * own) for t, e in zip(ticks, evens, strict=True)]
        found.append((misfit + sum(off), ticks))
    return next(ticks for misfit, ticks in found if misfit <= min(found)[0] + repair.TIE)


def go_on(times, start, stop):
    """Return the ticks that a pixel gets in a gap beyond its spikes `times`, the nearest first."""
    times, _ = even_train(times, stop - start)
    if len(times) < 2:
        return []
    step = (times[0] - times[-1]) / (len(times) - 1)  # with its sign
    at = place(times, abs(step))
    silence = start - at if step > 0 else at - (stop - 1)
    if silence >= 2 * abs(step) - repair.TIE:
        step = math.copysign(silence, step)
    return [t for t in (math.floor(at + k * step + 0.5 + repair.TIE) for k in range(1, TICKS)) if start <= t < stop]


def twin(fired, lost):
    """Return one pixel's spikes [T] with those of its lost ticks, and where these are certain, in plain Python."""
    certain = np.zeros(len(fired), bool)
    fired, recorded = fired.copy(), [int(t) for t in np.flatnonzero(fired & ~lost)]
    runs = np.flatnonzero(np.diff(np.concatenate([[0], lost, [0]]).astype(int))).reshape(-1, 2).tolist()
    for known in (False, True):
        for p, q in zip([None, *recorded], [*recorded, None], strict=True):
            low, high = -1 if p is None else p, len(fired) if q is None else q
            own = [(a, b) for a, b in runs if low < a and b <= high]
            if not own:
                continue
            fired[low + 1 : high] = 0
            later = min([a for a, b in runs if a >= high], default=len(fired)) if not known else len(fired)
            past = [t for t in range(high, later) if fired[t]]
            if p is not None and q is not None:
                ticks = [t for a, b in own for t in range(a, b)]
                fired[between([t for t in range(high) if fired[t]][::-1], past, ticks)] = 1
                if known and len(ticks) <= MOST:
                    found = slow_likely([t for t in range(low + 1) if fired[t]][::-1], past, ticks)
                    if found:
                        fired[low + 1 : high] = 0
                        fired[found[0]], certain[found[1]] = 1, True
            elif p is not None:
                for a, b in own:
                    fired[go_on([t for t in range(a) if fired[t]][::-1], a, b)] = 1
            elif q is not None:
                for a, b in own[::-1]:
                    fired[go_on([t for t in range(b, later) if fired[t]], a, b)] = 1
    return fired, certain


@settings(max_examples=12, deadline=None)  # of 42 pixels each
@given(
    st.lists(st.tuples(st.integers(0, 130), st.integers(1, 14)), min_size=1, max_size=12),
    st.booleans(),
    st.integers(0, 2**31),
)
def test_the_kernel_is_its_twin_whatever_is_lost(gaps, even, seed):
    rng, lost, size = np.random.default_rng(seed), np.zeros(140, bool), (2, WIDTH)
    rates = rng.random(size) ** 2
    spikes = (rng.random((140, *size)) < rates).astype(np.uint8)
    if even:
        spikes = steady(rates, 140, seed)
    spikes[:, 0, 0], spikes[:, 0, 1], spikes[:, 0, 2] = 0, 1, 0
    spikes[[40, 133], 0, 2] = 1
    for first, ticks in gaps:
        lost[first : first + ticks] = True
    spikes[lost] = 0
    expected = np.array([twin(s, lost) for s in spikes.reshape(140, -1).T]).transpose(1, 2, 0)
    stream = repair.fill_gaps(stream_of(spikes, [(int(t), 1) for t in np.flatnonzero(lost)]))
    sure = np.unpackbits(stream.certain, axis=1, count=rates.size, bitorder="little").reshape(-1, *size)
    found = stream.window(0, 140).reshape(140, -1), sure[:, ::-1].reshape(len(sure), -1)
    wrong = (found[0] != expected[0]).any(axis=0) | (found[1] != expected[1][lost]).any(axis=0)
    assert wrong.sum() <= 1, "of 42 pixels: what is as near may round to either side"


def filled_ticks(spikes, lost):
    """Return what one pixel's lost ticks hold once they are filled."""
    fired = np.zeros((TICKS, HEIGHT, WIDTH), np.uint8)
    fired[spikes] = 1
    found = repair.fill_gaps(stream_of(fired, [(t, 1) for t in lost])).window(0, TICKS)[:, 0, 0]
    return [t for t in lost if found[t]]


def test_a_lost_spike_lies_in_a_lost_tick():
    """Even spikes every ten ticks: one that is lost comes back, and no other lost tick gets one."""
    every = list(range(5, 400, 10))
    assert filled_ticks(every, [205]) == [205]
    assert filled_ticks(every, [203, 205, 212, 225]) == [205, 225], "several gaps between two spikes"
    assert filled_ticks(every, [201, 209]) == []
    late = [t if t <= 200 else t + 5 for t in every[:-1]]  # an interval of 15 ticks: lower light, or a lost spike
    assert filled_ticks(late, [196]) == [], "far from the middle"


def test_a_stream_without_gaps_is_itself():
    stream = stream_of(steady(RATES))
    assert repair.fill_gaps(stream) is stream and repair.fill_pixels(stream, None) is stream
    assert repair.fill_pixels(stream, np.zeros((HEIGHT, WIDTH), bool)) is stream


@pytest.mark.parametrize("bottom_up", [True, False])
def test_a_bad_pixel_fires_as_its_neighbour(bottom_up):
    spikes = steady(RATES)
    bad = np.zeros((HEIGHT, WIDTH), bool)
    bad[2, 3] = bad[2, 4] = bad[5, 20] = True
    stream = stream_of(np.where(bad, 1, spikes).astype(np.uint8), bottom_up=bottom_up)
    stream = replace(stream, packed=stream.packed.copy())
    stream.packed.flags.writeable = False
    found = repair.fill_pixels(stream, bad).window(0, TICKS)
    np.testing.assert_array_equal(found[:, ~bad], spikes[:, ~bad])
    for y, x in np.argwhere(bad):
        near = [(a, b) for a in range(y - 1, y + 2) for b in range(x - 1, x + 2) if 0 <= a < HEIGHT and 0 <= b < WIDTH]
        assert any((found[:, y, x] == spikes[:, a, b]).all() for a, b in near if not bad[a, b])


def test_a_bad_pixel_is_as_certain_as_its_neighbour():
    spikes, bad = steady(RATES), np.zeros((HEIGHT, WIDTH), bool)
    bad[2, 3] = True
    spikes[:, 2, 3] = 0  # of which nothing is certain
    filled = repair.fill_gaps(stream_of(spikes, [(t, 1) for t in range(7, TICKS - 2, 23)]))
    certain = SpikeStream(repair.fill_pixels(filled, bad).certain, WIDTH, HEIGHT, 2e4)
    sure = certain.window(0, certain.n_ticks)
    near = [sure[:, y, x].tolist() for y, x in ((1, 3), (3, 3), (2, 2), (2, 4))]
    assert sure[:, 2, 3].any() and sure[:, 2, 3].tolist() in near


def test_gaps_of_a_mapped_file_are_filled_next_to_it(tmp_path):
    """The file stays as it is, and of its pages the few that change are in memory."""
    width, height, ticks = 256, 128, 2000  # a page a tick
    gaps = tuple(Gap("cam_00", first, 2, "overflow") for first in range(100, 1900, 400))
    path = tmp_path / "lost.dat"
    path.write_bytes(np.random.default_rng(0).bytes(ticks * width * height // 8))
    stream = open_stream(path, width, height, 20000.0, gaps=gaps)
    in_memory = replace(stream, packed=np.array(stream.packed))
    expected, content = repair.fill_gaps(in_memory).packed, path.read_bytes()
    before = resident_bytes("RssAnon") if STATUS.is_file() else 0
    filled = repair.fill_gaps(stream)
    if STATUS.is_file():
        assert resident_bytes("RssAnon") - before < len(content) / 4
    filled.release()
    np.testing.assert_array_equal(filled.packed, expected)
    assert path.read_bytes() == content and (filled.packed[100] != stream.packed[100]).any()
    part = replace(stream, packed=stream.packed[50:], gaps=(replace(gaps[0], first_tick=50),))
    expected = repair.fill_gaps(replace(part, packed=np.array(part.packed))).packed
    np.testing.assert_array_equal(repair.fill_gaps(part).packed, expected, err_msg="a part of a file's ticks")
