"""TFSTP against its published equations in 50 digits, at rest, at the clip's ends, and against the light."""

from decimal import Decimal
from typing import Any

import numpy as np
import pytest
from slow_images import slow_tfstp_pixel, stream_of

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.images.tfi import tfi_image
from spike4dgs.baselines.images.tfp import tfp_image
from spike4dgs.baselines.images.tfstp import TfstpSettings, _decays, tfstp_image
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.spikes.stream import SpikeStream


def one_row(n: int, *pixels: Any) -> SpikeStream:
    """A clip of `n` ticks of one row, whose pixels fire at the given ticks."""
    spikes = np.zeros((n, 1, len(pixels)), np.uint8)
    for x, ticks in enumerate(pixels):
        spikes[list(ticks), 0, x] = 1
    return stream_of(spikes)


def test_the_decays_of_a_clip_are_computed_once_for_all_its_images() -> None:
    stream = one_row(50, [3, 20, 41])
    _decays.cache_clear()
    images = [tfstp_image(stream, tick) for tick in (10, 25, 40)]
    assert _decays.cache_info().misses == 1
    _decays.cache_clear()
    np.testing.assert_array_equal(images[1], tfstp_image(stream, 25))


def test_other_constants_are_settings_of_the_maker() -> None:
    n, rng = 120, np.random.default_rng(5)
    pixels = [list(np.flatnonzero(rng.random(n) < p)) for p in (0.05, 0.2, 0.5)]
    maker = IMAGES["tfstp"].with_settings(TfstpSettings(u0=0.25, jump=0.5, d_ticks=2, f_ticks=5.0, memory_ticks=200))
    constants = Decimal("0.25"), Decimal("0.5"), Decimal(2), Decimal(5)
    expected = [slow_tfstp_pixel(p, n, 80, constants) for p in pixels]
    np.testing.assert_allclose(maker(one_row(n, *pixels), [80], 1.0)[0, 0], expected, rtol=1e-6)
    assert not np.allclose(IMAGES["tfstp"](one_row(n, *pixels), [80], 1.0)[0, 0], expected, rtol=1e-3)


@pytest.mark.parametrize("wrong", [{"u0": 0.0}, {"jump": 1.0}, {"d_ticks": -1.0}, {"memory_ticks": 0}])
def test_constants_without_a_meaning_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(UserError, match="tfstp: expected u0 and jump between 0 and 1, .* found TfstpSettings"):
        TfstpSettings(**wrong)


def test_forgetting_what_is_older_than_the_memory_changes_little() -> None:
    """Bright, then dark, just before the memory begins, and the other way round: the worst cases; then random ones."""
    n, rng, memory = 400, np.random.default_rng(3), TfstpSettings().memory_ticks
    pixels = [
        [*range(0, start, first), *range(start, n, second)]
        for start in (200, 260, 300 - memory, 300 - memory - 1)
        for first, second in ((1, 40), (1, 119), (1, 121), (40, 1), (3, 60), (90, 7))
    ]
    pixels += [list(np.flatnonzero(rng.random(n) < p)) for p in (0.01, 0.02, 0.05, 0.3, 0.8)]
    image = tfstp_image(one_row(n, *pixels), 300)[0]
    np.testing.assert_allclose(image, [slow_tfstp_pixel(p, n, 300) for p in pixels], rtol=1e-4)


@pytest.mark.parametrize("interval", [1, 2, 3, 7, 20, 90, 700])
def test_a_constant_interval_gives_exactly_its_rate(interval: int) -> None:
    n = 3 * interval + 5
    fired = range(interval // 2, n, interval)
    stream = one_row(n, fired)
    for tick in {0, 1, n // 2, n - 1}:
        np.testing.assert_allclose(tfstp_image(stream, tick), 1 / interval, rtol=1e-7)


def test_sparse_pixels_at_the_ends_of_the_clip() -> None:
    """Without a memory it is TFI: with no spike, with one spike, and before the second one."""
    stream = one_row(20, [], [0], [19], [7], [0, 19], [0, 4], [15, 19], [3, 5])
    for tick, same in ((0, 8), (4, 8), (5, 5)):
        np.testing.assert_allclose(tfstp_image(stream, tick)[0, :same], tfi_image(stream, tick)[0, :same], rtol=1e-6)
    assert tfstp_image(stream, 19)[0, 4] == pytest.approx(1 / 19)
    assert 1 / 16 < tfstp_image(stream, 19)[0, 5] < 1 / 4, "dark since tick 4, but remembered"


def test_it_lags_behind_a_change_of_light_and_arrives() -> None:
    """The memory is about F = 10 ticks: after the light halves, the rate falls from above, and is there in 60 ticks."""
    stream = one_row(200, [*range(0, 100, 2), *range(100, 200, 4)])
    rates = np.array([tfstp_image(stream, t)[0, 0] for t in range(90, 180, 4)])
    assert rates[0] == pytest.approx(0.5) and 0.27 < rates[3] < 0.5
    assert (np.diff(rates[3:]) <= 1e-7).all() and rates[-1] == pytest.approx(0.25, rel=1e-3)


def test_on_steady_noise_free_light_it_stands_between_intervals_and_counts() -> None:
    """Errors of an image of many grays: below TFI's. A window of 40 ticks beats both where nothing moves."""
    light = np.random.default_rng(0).uniform(0.03, 0.6, (30, 40))
    charge = np.random.default_rng(1).random((30, 40)) + light * np.arange(301)[:, None, None]
    stream = stream_of(np.diff(np.floor(charge), axis=0).astype(np.uint8))
    tfp, tfstp, tfi = (np.sqrt(np.mean((m(stream, 150) - light) ** 2)) for m in (tfp_image, tfstp_image, tfi_image))
    assert tfp < tfstp < 0.75 * tfi
