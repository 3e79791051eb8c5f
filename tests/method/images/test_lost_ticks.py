"""Images of recordings that lack ticks: against the slow twin, against whole recordings, and by their bounds."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from ideal_spikes import fire, gathered, sweeping
from slow_images import slow_adaptive, slow_intervals, stream_of

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.repair import fill_gaps
from spike4dgs.method.images.adaptive import adaptive_image
from spike4dgs.method.images.intervals import IntervalSettings, intervals
from spike4dgs.method.training_views.instants import recount


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
    st.sampled_from([0.0, 0.02, 0.1, 0.4, 0.9]),
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
    rate, spans, doubts = intervals(stream, tick, s)
    slow_rate, slow_spans, slow_doubts = slow_intervals(spikes, tick, s, doubt)
    np.testing.assert_allclose(np.zeros_like(slow_doubts) if doubts is None else doubts, slow_doubts, rtol=1e-6)
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
    (rate, spans, _), (expected, own, _) = intervals(stream_of(spikes, lost=far), 30), intervals(stream_of(spikes), 30)
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
    rate, spans, doubts = intervals(stream_of(spikes, lost=lost_at(80, [(40, 1)])), 30)
    np.testing.assert_allclose(rate[0], [0, 1 / 80, 2 / 80], rtol=1e-6)
    assert (spans[0] == -6).all() and (spans[1] == 6).all() and not doubts.any()
    nothing = stream_of(np.zeros((20, 2, 2), bool), lost=np.ones(20, bool))
    assert not intervals(nothing, 10)[0].any() and not adaptive_image(nothing, 10).any()


@pytest.mark.parametrize("burst", [1, 5])
def test_spans_of_moving_light_end_at_certain_spikes_and_hold_as_much_as_they_say(burst):
    rates = sweeping(400, 24, 40, 0.1)
    spikes, lost = fire(rates, np.random.default_rng(0).random((24, 40))), drawn(400, 0.05, burst, 3)
    assert lost.sum() >= 15, "a test of nothing"
    stream, fired = recording(spikes, lost), np.cumsum(spikes, axis=0)
    known = np.repeat(~lost[:, None, None], 24, axis=1).repeat(40, axis=2)
    sure = np.unpackbits(stream.certain, axis=1, bitorder="little").reshape(-1, 24, 40)
    known[lost] = sure[:, ::-1] if stream.rows_bottom_up else sure
    within = []
    for tick in range(30, 370, 7):
        rate, (first, last), (most, one, without) = intervals(stream, tick)
        y, x = np.nonzero((first != -6) | (last != 6))
        a, b = (np.floor(tick + end[y, x]).astype(int) for end in (first, last))
        assert known[a, y, x].all() and known[b, y, x].all()
        at = most[y, x] > 0
        spikes_in = (fired[b, y, x] - fired[a, y, x])[at] * one[y, x][at]
        least, greatest = without[y, x][at], (without + most * one)[y, x][at]
        within.append((least <= spikes_in + 1e-6) & (spikes_in <= greatest + 1e-6))
        assert ((least <= rate[y, x][at]) & (rate[y, x][at] <= greatest + 1e-6)).all()
    assert len(np.concatenate(within)) > 300, "a test of nothing"
    assert np.concatenate(within).mean() > 0.97, "what counts as certain is wrong now and then"


@pytest.mark.parametrize("burst", [1, 5])
def test_who_knows_the_mean_of_a_span_to_a_tenth_of_a_spike_knows_what_was_lost(burst):
    """What is left is the error of half a tick at either end, as of a whole recording."""
    rates = sweeping(400, 24, 40, 0.1)
    spikes, lost = fire(rates, np.random.default_rng(0).random((24, 40))), drawn(400, 0.1, burst, 3)
    maker, stream, y, x = IMAGES["intervals"], recording(spikes, lost), *np.mgrid[:24, :40]
    by, ticks, rng = gathered(rates), list(range(30, 370, 20)), np.random.default_rng(4)
    images, spans, doubts = maker.with_spans(stream, ticks, 0.5)
    found = {"known": [], "said": []}
    for tick, image, (first, last), own in zip(ticks, images, spans, doubts, strict=True):
        at = np.nonzero(own[0])
        a, b = tick + first.astype(float)[at], tick + last.astype(float)[at]
        exact = (by(b, *(grid[at] for grid in (y, x))) - by(a, *(grid[at] for grid in (y, x)))) / (b - a) / 0.5
        told = exact + rng.uniform(-0.1, 0.1, len(exact)) * own[1][at]
        means = torch.zeros(1, 24, 40)
        means[0][at] = torch.from_numpy(told.astype(np.float32))
        right = image[at] + recount(means, torch.from_numpy(own)[None])[0].numpy()[at]
        for name, value in (("known", right), ("said", image[at])):
            found[name].append((value - exact) / own[1][at])  # in spikes
    known, said = (np.concatenate(found[name]) for name in ("known", "said"))
    assert len(known) > 300, "a test of nothing"
    sure = np.isfinite(known)
    assert sure.mean() > 0.75, "a bright pixel's span has a third of a spike of its own error"
    assert np.mean(known[sure] ** 2) < 0.15 * np.mean(said[sure] ** 2)
