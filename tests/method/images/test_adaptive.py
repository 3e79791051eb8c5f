"""Adaptive windows against a slow twin on whole arrays, at rest, at steps of light, and at the clip's ends."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.baselines.images.reference import slow_adaptive
from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.images.adaptive import AdaptiveSettings, adaptive_image, half_windows, spike_times


def stream_of(spikes, bottom_up=True):
    return SpikeStream(pack(spikes, bottom_up), spikes.shape[2], spikes.shape[1], 20000.0, bottom_up)


def fire(rates, charge):
    """Spikes [T, H, W] of an ideal pixel: rates [T, H, W] in spikes per tick, charges [H, W] at the start."""
    total = charge + np.cumsum(rates, axis=0)
    return np.diff(np.floor(total), axis=0, prepend=np.floor(charge)[None]) > 0


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 5), st.integers(1, 19), st.integers(1, 90), st.booleans(), st.integers(0, 2**31))
def test_images_are_those_of_the_definition(height, width, n, bottom_up, seed):
    rng = np.random.default_rng(seed)
    rates = rng.random((height, width)) * np.where(np.arange(n) < n // 2, 1.0, rng.random())[:, None, None]
    spikes = fire(rates, rng.random((height, width))) ^ (rng.random((n, height, width)) < 0.02)
    tick = int(rng.integers(n))
    found = adaptive_image(stream_of(spikes, bottom_up), tick)
    np.testing.assert_allclose(found, slow_adaptive(spikes, tick), rtol=1e-6)


def test_the_windows_are_settings_of_the_maker():
    rng = np.random.default_rng(8)
    spikes = fire(np.where(np.arange(90) < 40, 0.2, 0.5)[:, None, None] * rng.random((9, 11)), rng.random((9, 11)))
    wide = AdaptiveSettings(shortest=3.0, growth=1.2, shared_px=5)
    found = IMAGES["adaptive"].with_settings(wide)(stream_of(spikes), [35], 1.0)[0]
    np.testing.assert_allclose(found, slow_adaptive(spikes, 35, wide), rtol=1e-6)
    assert half_windows(90, wide)[0] == 3 and not np.array_equal(found, adaptive_image(stream_of(spikes), 35))


@pytest.mark.parametrize("wrong", [{"shortest": 0.0}, {"growth": 1.0}, {"shared_px": 2}])
def test_windows_without_a_meaning_are_refused(wrong):
    with pytest.raises(UserError, match="adaptive: expected shortest above 0, .* found AdaptiveSettings"):
        AdaptiveSettings(**wrong)


def test_constant_light_is_known_as_well_as_the_clip_allows():
    rng = np.random.default_rng(1)
    rates = rng.uniform(0.02, 0.6, (25, 40))
    stream = stream_of(fire(np.broadcast_to(rates, (400, 25, 40)), rng.random((25, 40))))
    error = adaptive_image(stream, 200) - rates
    assert np.abs(error / rates).max() < 1 / 250  # no pixel is led astray: 1 / T, and dark pixels see less of the clip
    assert np.sqrt(np.mean((error / rates) ** 2)) < 1.5e-3  # sqrt(1/6) / 400 is 1.0e-3
    assert np.abs(IMAGES["tfp"](stream, [200], 1.0)[0] - rates).std() > 10 * error.std()


def test_a_step_of_light_is_not_blurred():
    """Eight ticks after a step TFP's window of 41 still holds twelve ticks of the old light."""
    rates = np.full((400, 24, 24), 0.2)
    rates[200:] = 0.4
    stream = stream_of(fire(rates, np.random.default_rng(2).random((24, 24))))
    for tick, truth in ((150, 0.2), (192, 0.2), (208, 0.4), (250, 0.4)):
        assert adaptive_image(stream, tick).mean() == pytest.approx(truth, abs=0.03)
    assert abs(IMAGES["tfp"](stream, [208], 1.0)[0].mean() - 0.4) > 0.05


def test_a_dark_stripe_between_bright_ones_is_dark():
    """No spike falls while it passes. The gap must count, though a constant rate explains the spikes on both sides."""
    rates = np.full((400, 24, 24), 0.5)
    rates[180:210] = 0.004
    stream = stream_of(fire(rates, np.random.default_rng(4).random((24, 24))))
    assert adaptive_image(stream, 195).max() < 0.08
    np.testing.assert_allclose(adaptive_image(stream, 160), 0.5, atol=0.02)


@pytest.mark.parametrize("fired", [[], [7]])
def test_pixels_with_fewer_than_two_spikes_have_the_clips_mean_rate(fired):
    spikes = np.zeros((50, 2, 9), bool)
    spikes[fired] = True
    for tick in (0, 25, 49):
        np.testing.assert_allclose(adaptive_image(stream_of(spikes), tick), len(fired) / 50)


def test_a_saturated_pixel_has_one_spike_a_tick():
    np.testing.assert_array_equal(adaptive_image(stream_of(np.ones((30, 3, 8), bool)), 3), 1)


def test_spike_times_are_those_of_the_plain_array():
    spikes = np.random.default_rng(3).random((70, 30, 41)) < 0.3
    found = spike_times(stream_of(spikes, bottom_up=False))
    pixel, tick = np.nonzero(spikes.reshape(70, -1).T)
    np.testing.assert_array_equal(found.ticks, tick)
    np.testing.assert_array_equal(found.starts, np.searchsorted(pixel, np.arange(30 * 41 + 1)))


def test_the_last_window_covers_the_clip_from_anywhere():
    for n in (1, 2, 3, 400, 2000, 100_000):
        assert half_windows(n)[-1] >= n * (1 - 1e-9)
        assert half_windows(n)[0] == 2
