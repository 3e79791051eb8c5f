"""TFP and TFI against slow float64 twins, at the clip's ends, and against the light that made the spikes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from slow_images import slow_tfi, slow_tfp, stream_of

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.images.tfi import tfi_image
from spike4dgs.baselines.images.tfp import TfpSettings, tfp_image
from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.settings import Settings


def random_spikes(n: int, height: int, width: int, seed: int) -> np.ndarray:
    """Every rate from never to always, so silent pixels, full ones and single spikes all occur."""
    rng = np.random.default_rng(seed)
    rate = rng.choice([0, 0.02, 0.1, 0.4, 0.9, 1], (height, width))
    return (rng.random((n, height, width)) < rate).astype(np.uint8)


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 50), st.integers(1, 19), st.integers(1, 21), st.booleans(), st.integers(0, 9), st.integers(1, 60))
def test_images_equal_the_slow_twins(
    n: int, height: int, width: int, bottom_up: bool, seed: int, half_window: int
) -> None:
    spikes = random_spikes(n, height, width, seed)
    stream = stream_of(spikes, bottom_up)
    for tick in {0, 1, n // 2, n - 2, n - 1} & set(range(n)):
        tfp, tfi = tfp_image(stream, tick, half_window), tfi_image(stream, tick)
        assert tfp.dtype == tfi.dtype == np.float32
        np.testing.assert_allclose(tfp, slow_tfp(spikes, tick, half_window), rtol=2e-7)
        np.testing.assert_allclose(tfi, slow_tfi(spikes, tick), rtol=6e-8)


def test_sparse_pixels_at_the_ends_of_the_clip() -> None:
    """One row of pixels that fire at the listed ticks of a clip of 20."""
    fired = [[], [0], [19], [7], [0, 19], [0, 4], [15, 19], [3, 5], list(range(20))]
    spikes = np.zeros((20, 1, len(fired)), np.uint8)
    for x, ticks in enumerate(fired):
        spikes[ticks, 0, x] = 1
    for tick, intervals in {
        0: [1e9, 20, 20, 20, 19, 4, 16, 4, 1],
        4: [1e9, 20, 20, 20, 19, 4, 16, 2, 1],
        5: [1e9, 20, 20, 20, 19, 16, 16, 2, 1],
        19: [1e9, 20, 20, 20, 19, 16, 4, 15, 1],
    }.items():
        found = 1 / np.maximum(tfi_image(stream_of(spikes), tick)[0], 1e-9)
        np.testing.assert_allclose(found, intervals, rtol=1e-6)


def test_the_interval_contains_the_start_of_the_tick() -> None:
    """Light that doubles at tick 30 shows in TFI at tick 30, not a tick before or after."""
    spikes = np.zeros((60, 1, 1), np.uint8)
    spikes[1:30:4] = spikes[29:60:2] = 1
    image = np.array([tfi_image(stream_of(spikes), tick)[0, 0] for tick in range(60)])
    np.testing.assert_allclose(image[2:30], 0.25)
    np.testing.assert_allclose(image[30:], 0.5)


@pytest.mark.parametrize("name", ["tfp", "tfi", "tfstp"])
@pytest.mark.parametrize("radiance", [0.02, 0.11, 0.3, 0.77, 1.0])
def test_constant_light_is_recovered_without_bias_or_flicker(name: str, radiance: float) -> None:
    """Ideal integrate-and-fire pixels of all phases, gain 0.6; also at the first and last ticks."""
    phase = (np.arange(2000).reshape(40, 50) + 0.5) / 2000
    charge = phase + 0.6 * radiance * np.arange(301)[:, None, None]
    stream = stream_of(np.diff(np.floor(charge), axis=0).astype(np.uint8))
    images = IMAGES[name](stream, [0, 1, 150, 298, 299], gain=0.6)
    assert images.shape == (5, 40, 50) and images.dtype == np.float32
    np.testing.assert_allclose(images.mean(axis=(1, 2)), radiance, rtol=0.03)
    intervals = IMAGES["tfi"](stream, [150], gain=0.6)[0]
    assert name == "tfp" or images[2].std() <= intervals.std() * (1 + 1e-6), "TFSTP flickers less than intervals do"


def test_a_moving_edge_is_where_it_was_at_the_start_of_the_tick() -> None:
    """The centred window has no lag: an edge at x = 0.25 t is found there to a tenth of a pixel."""
    t = np.arange(200)[:, None, None] + 0.5
    x = np.arange(80)[None, None] + 0.5
    light = np.broadcast_to(0.2 + 0.6 * np.clip(x - 0.25 * t + 0.5, 0, 1), (200, 60, 80))
    charge = np.cumsum(light, axis=0) + np.random.default_rng(1).random((60, 80))
    spikes = np.diff(np.floor(charge), axis=0, prepend=0).clip(0, 1).astype(np.uint8)
    for name in ("tfp", "tfi"):
        profile = IMAGES[name](stream_of(spikes), [120], gain=1.0)[0].mean(axis=0)
        edge = 80 - (profile - 0.2).clip(0).sum() / 0.6
        assert abs(edge - 30) < 0.1 if name == "tfp" else abs(edge - 30) < 0.5


@pytest.mark.parametrize("half_window", [0, 40000])
def test_a_window_out_of_range_is_refused(half_window: int) -> None:
    with pytest.raises(UserError, match="half_window: expected 1 to 32767 ticks"):
        tfp_image(stream_of(np.ones((20, 2, 2), np.uint8)), 10, half_window)


def test_the_window_is_a_setting_of_the_maker() -> None:
    stream, tfp = stream_of(random_spikes(60, 6, 9, 1)), IMAGES["tfp"]
    narrow = tfp.with_settings(TfpSettings(half_window=4))
    np.testing.assert_array_equal(narrow(stream, [30], 1.0)[0], tfp_image(stream, 30, 4))
    np.testing.assert_array_equal(tfp(stream, [30], 1.0)[0], tfp_image(stream, 30, 20))
    with pytest.raises(TypeError, match="tfp has TfpSettings, not Settings"):
        tfp.with_settings(Settings())
    assert IMAGES["tfi"].settings == Settings()
