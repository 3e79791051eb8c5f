"""Adaptive windows against a slow twin on whole arrays, at rest, at steps of light, and at the clip's ends."""

import numpy as np
import pytest
from ideal_spikes import fire, gathered, sweeping
from slow_images import slow_adaptive, stream_of

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.images.adaptive import AdaptiveSettings, adaptive_image, half_windows
from spike4dgs.method.images.intervals import IntervalSettings, intervals


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


def test_windows_that_no_number_of_8_bits_tells_are_refused():
    assert len(half_windows(400, AdaptiveSettings(growth=1.022))) < 256
    with pytest.raises(UserError, match="at most 256 windows for a clip of 400 ticks, found 260 with .* raise growth"):
        half_windows(400, AdaptiveSettings(growth=1.0207))


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


def test_the_last_window_covers_the_clip_from_anywhere():
    for n in (1, 2, 3, 400, 2000, 100_000):
        assert half_windows(n)[-1] >= n * (1 - 1e-9)
        assert half_windows(n)[0] == 2


@pytest.mark.parametrize("wrong", [{"half": 1.9}, {"half": -6.0}, {"still": 0.0}, {"shortest": 7.0}, {"growth": 1.0}])
def test_settings_without_a_meaning_are_refused(wrong):
    with pytest.raises(UserError, match="correct the settings"):
        IntervalSettings(**wrong)


def test_constant_light_keeps_the_long_windows_of_adaptive():
    spikes = fire(np.full((200, 6, 7), 0.3) * np.linspace(0.2, 2, 42).reshape(6, 7), np.full((6, 7), 0.4))
    rate, spans, _ = intervals(stream_of(spikes), 100)
    np.testing.assert_array_equal(rate, adaptive_image(stream_of(spikes), 100))
    half = IntervalSettings().half
    assert (spans[0] == -half).all() and (spans[1] == half).all()


def errors(n=160, half=10.0, seed=0):
    """Of pixels of moving light that change: rate minus the exact mean over its span, rate, and length of the span."""
    rng = np.random.default_rng(seed)
    rates = sweeping(n, 24, 40, 0.1, seed)
    stream, by = stream_of(fire(rates, rng.random((24, 40)))), gathered(rates)
    found = []
    for tick in range(30, n - 30, 7):
        rate, (first, last), _ = intervals(stream, tick, IntervalSettings(half=half))
        y, x = np.nonzero((first != -half) | (last != half))
        a, b = tick + first[y, x], tick + last[y, x]
        found.append((rate[y, x] - (by(b, y, x) - by(a, y, x)) / (b - a), rate[y, x], b - a))
    return (np.concatenate(column) for column in zip(*found, strict=True))


def test_moving_light_is_measured_without_bias_and_as_precisely_as_said():
    """sqrt(2 / 12) / length of the rate is the standard error that half a tick at either end makes: within 1.5."""
    error, rate, length = errors()
    implied = np.sqrt(1 / 6) * rate / length
    assert len(error) > 3000, "a test of nothing"
    assert 1 / 1.5 < np.sqrt(np.mean((error / implied) ** 2)) < 1.5
    assert abs(error).max() < (rate / length * 1.0001).max(), "never more than half a tick at both ends"
    assert abs(error.mean()) < 0.1 * implied.mean()


def test_a_longer_span_is_more_precise():
    error, rate, length = errors(half=30.0)
    relative, long = abs(error) / rate, length > 20
    assert min(long.sum(), (length < 10).sum()) > 300, "a test of nothing"
    assert relative[long].mean() < relative[length < 10].mean() / 2.5


def test_the_sooner_light_changes_the_shorter_the_span():
    n = 400
    rates = np.full((n, 20, 40), 0.6)  # still; and from the middle on, faster and faster to the right
    rates[:, :, 20:] = np.stack([sweeping(n, 20, 20, v)[:, :, 10] for v in np.linspace(0.02, 0.5, 20)], axis=2)
    _, (first, last), _ = intervals(stream_of(fire(rates, np.random.default_rng(0).random((20, 40)))), 200)
    length = np.median(last - first, axis=0)
    half = IntervalSettings().half
    assert (first[:, :18] == -half).all() and (last[:, :18] == half).all(), "constant light has no span of its own"
    assert length[35:].mean() < 0.7 * length[22:26].mean()
    assert (last - first)[:, 21:].max() < 2 * half + 2 / rates.min(), "as long as half, to the nearest spikes"


def test_the_maker_gives_images_and_spans():
    spikes = fire(sweeping(80, 12, 16, 0.2), np.random.default_rng(1).random((12, 16)))
    maker, stream = IMAGES["intervals"], stream_of(spikes)
    images, spans, doubts = maker.with_spans(stream, [20, 40], 0.5)
    rate, span, _ = intervals(stream, 40)
    np.testing.assert_allclose(images[1], rate / 0.5, rtol=1e-6)
    np.testing.assert_array_equal(spans[1], span)
    assert doubts is None, "no tick is lost"
    assert IMAGES["adaptive"].with_spans(stream, [20], 0.5)[1] is None, "an instant"
