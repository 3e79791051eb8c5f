"""Images of recordings that lack ticks: against the slow twin, against whole recordings, and by their bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from ideal_spikes import fire, gathered, sweeping
from slow_images import slow_adaptive, slow_intervals, stream_of

from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.repair import fill_gaps
from spike4dgs.method.images.adaptive import adaptive_image
from spike4dgs.method.images.intervals import FOLLOWED, IntervalSettings, intervals


def lost_at(n, gaps):
    lost = np.zeros(n, bool)
    for first, ticks in gaps:
        lost[first : first + ticks] = True
    return lost


def drawn(n, share, burst, seed):
    """Ticks [n] of which about `share` are lost, `burst` at a time."""
    starts = np.random.default_rng(seed).random(n) < share / burst
    return np.convolve(starts, np.ones(burst, int))[:n] > 0


def recording(spikes, lost):
    """A stream without the spikes of lost ticks, filled as those of a scene are."""
    cut = spikes & ~lost[:, None, None]
    gaps = tuple(Gap("cam_00", int(t), 1, "lost") for t in np.flatnonzero(lost))
    return fill_gaps(replace(stream_of(cut), gaps=gaps))


@settings(max_examples=60, deadline=None)
@example(90, True, 0.0, 1, 7)  # none is lost
@example(90, False, 1.0, 1, 7)  # all are
@given(
    st.integers(1, 120),
    st.booleans(),
    st.sampled_from([0.02, 0.1, 0.4, 0.9]),
    st.sampled_from([1, 3, 9]),
    st.integers(0, 2**31),
)
def test_images_are_those_of_the_slow_twin_whatever_lost_ticks_were_filled_with(n, bottom_up, share, burst, seed):
    rng = np.random.default_rng(seed)
    rates = rng.random((n, 4, 5)) ** 3 * rng.uniform(0, 1.2, (4, 5)) * (np.arange(20).reshape(4, 5) != 7)
    spikes, lost, tick = fire(rates, rng.random((4, 5))), drawn(n, share, burst, seed), int(rng.integers(n))
    spikes[lost] ^= rng.random((int(lost.sum()), 4, 5)) < 0.1  # filled with a wrong spike now and then
    s = IntervalSettings(half=float(rng.choice([4.0, 6.0, 9.7])), still=float(rng.choice([10.0, 80.0])))
    certain = (rng.random(spikes.shape) < rng.choice([0.3, 0.9, 1.0])) if seed % 3 else None  # None: nothing is
    doubt = lost[:, None, None] & (True if certain is None else ~certain)
    doubt = np.broadcast_to(doubt, spikes.shape)
    stream = stream_of(spikes, bottom_up, lost, certain)
    np.testing.assert_allclose(adaptive_image(stream, tick), slow_adaptive(spikes, tick, lost=doubt), rtol=1e-6)
    rate, spans = intervals(stream, tick, s)
    slow_rate, slow_spans = slow_intervals(spikes, tick, s, doubt)
    np.testing.assert_allclose(spans, slow_spans, rtol=1e-6)
    np.testing.assert_allclose(rate, slow_rate, rtol=1e-6)


def test_a_recording_that_lacks_nothing_keeps_every_bit():
    rng = np.random.default_rng(5)
    spikes = fire(rng.random((150, 8, 9)) ** 3, rng.random((8, 9)))
    far = lost_at(150, [(140, 3)])  # beyond all that the images of tick 30 look at, but for windows of the whole clip
    for tick in (0, 70, 149):
        expected, found = (intervals(s, tick) for s in (stream_of(spikes), stream_of(spikes, lost=np.zeros(150, bool))))
        np.testing.assert_array_equal(found[0], expected[0])
        np.testing.assert_array_equal(found[1], expected[1])
    (rate, spans), (expected, own) = intervals(stream_of(spikes, lost=far), 30), intervals(stream_of(spikes), 30)
    changing = (own[0] != -IntervalSettings().half) & (spans[0] == own[0]) & (spans[1] == own[1])
    assert changing.mean() > 0.9
    np.testing.assert_array_equal(rate[changing], expected[changing])


@pytest.mark.parametrize(
    "gaps", [[(t, 1) for t in range(9, 390, 19)], [(50, 5), (140, 5), (300, 5)], [(0, 6), (394, 6)], [(180, 40)]]
)
def test_constant_light_is_known_as_if_nothing_were_lost(gaps):
    rates = np.random.default_rng(1).uniform(0.02, 0.6, (25, 40))
    spikes = fire(np.broadcast_to(rates, (400, 25, 40)), np.random.default_rng(2).random((25, 40)))
    stream = recording(spikes, lost_at(400, gaps))
    for image in (adaptive_image(stream, 200), intervals(stream, 200)[0]):
        wrong = abs(image - rates) / rates
        assert np.median(wrong) < 2e-3
        assert np.quantile(wrong, 0.95) < 0.02


def test_a_pixel_of_no_recorded_spike_has_what_it_was_filled_with():
    spikes = np.zeros((80, 1, 3), bool)
    spikes[40, 0, 1] = spikes[[40, 60], 0, 2] = True
    rate, spans = intervals(stream_of(spikes, lost=lost_at(80, [(40, 1)])), 30)
    np.testing.assert_allclose(rate[0], [0, 1 / 80, 2 / 80], rtol=1e-6)
    assert (spans[0] == -6).all() and (spans[1] == 6).all()
    nothing = stream_of(np.zeros((20, 2, 2), bool), lost=np.ones(20, bool))
    assert not intervals(nothing, 10)[0].any() and not adaptive_image(nothing, 10).any()


@pytest.mark.parametrize("burst", [1, 5])
def test_moving_light_is_measured_better_than_by_filled_spikes(burst):
    """Spans end at certain spikes, and the rate is right on average; filled spikes that count as recorded err more."""
    rates = sweeping(400, 24, 40, 0.1)
    spikes, lost = fire(rates, np.random.default_rng(0).random((24, 40))), drawn(400, 0.05, burst, 3)
    assert lost.sum() >= 15, "a test of nothing"
    stream, y, x = recording(spikes, lost), *np.mgrid[:24, :40]
    error, by = {"filled": [], "lost": [], "whole": []}, gathered(rates)
    known = np.repeat(~lost[:, None, None], 24, axis=1).repeat(40, axis=2)
    sure = np.unpackbits(stream.certain, axis=1, bitorder="little").reshape(-1, 24, 40)
    known[lost] = sure[:, ::-1] if stream.rows_bottom_up else sure
    for tick in range(30, 370, 7):
        for name, own in (("filled", replace(stream, filled=())), ("lost", stream), ("whole", stream_of(spikes))):
            rate, span = intervals(own, tick)
            a, b = (np.clip(tick + end.astype(float), 0, 399.9) for end in span)
            error[name].append(rate - (by(b, y, x) - by(a, y, x)) / (b - a))
            if name == "lost":
                for end, ticks in ((-6, a), (6, b)):
                    at = np.nonzero(span[int(end > 0)] != end)
                    assert known[(ticks[at] - 0.5).astype(int), *at].all()
                assert abs(span).max() < 30
    square = {name: np.mean(np.square(e)) for name, e in error.items()}
    assert square["lost"] - square["whole"] < 0.6 * (square["filled"] - square["whole"])
    assert abs(np.mean(error["lost"])) < 0.004


def test_a_span_lies_between_lost_ticks_and_is_not_moved_far():
    spikes = np.zeros((100, 3, 3), bool)
    spikes[::2], spikes[50:60] = True, True  # light changes: short windows
    lost, half = lost_at(100, [(53, 1)]), IntervalSettings().half
    for tick in range(44, 66):
        rate, (first, last) = intervals(stream_of(spikes, lost=lost), tick)
        if first[1, 1] == -half and last[1, 1] == half:
            continue
        a, b = (int(tick + end[1, 1] - 0.5) for end in (first, last))
        assert not lost[a : b + 1].any() and max(-first[1, 1], last[1, 1]) <= FOLLOWED * half
        assert rate[1, 1] == pytest.approx(spikes[a:b, 1, 1].sum() / (b - a))
