"""The conventional camera's exposures against the simulator's twin, tick by tick."""

from __future__ import annotations

import numpy as np
import pytest

from spike4dgs.generators.other_sensors import EXPOSURE_S, FPS, exposures
from spike4dgs.generators.sensor.reference import tick_means


def smooth_keys(spacing, n_ticks, shape=(5, 7)):
    """Return keys of a slow, smooth pattern, monotone between keys almost everywhere."""
    ticks = np.arange(0, n_ticks + spacing, spacing)
    phase = np.random.default_rng(0).uniform(0, 6.3, shape)
    return (0.5 + 0.3 * np.sin(phase + ticks[:, None, None] / 150)).astype(np.float32), ticks.tolist()


@pytest.mark.parametrize("spacing", [1, 3, 10, 20])
def test_a_frame_is_the_mean_of_its_ticks(spacing):
    n, rate = 600, 20_000
    keys, ticks = smooth_keys(spacing, n)
    means = np.stack(list(tick_means(keys, ticks, n)))
    frames = list(exposures(keys, ticks, n, rate))
    assert [tick for tick, _ in frames] == [0, 333]
    length = round(EXPOSURE_S * rate)
    for tick, image in frames:
        assert image.dtype == np.float32 and image.shape == (5, 7)
        np.testing.assert_allclose(image, means[tick : tick + length].mean(0), atol=2e-4)  # the clamp at extrema


@pytest.mark.parametrize(("n_ticks", "count"), [(80, 0), (166, 0), (167, 1), (400, 1), (500, 2), (2000, 6)])
def test_only_whole_exposures(n_ticks, count):
    keys, ticks = smooth_keys(20, n_ticks)
    starts = [tick for tick, _ in exposures(keys, ticks, n_ticks, 20_000)]
    assert starts == [round(k * 20_000 / FPS) for k in range(count)]


def test_a_moving_edge_is_smeared_over_its_path():
    x = np.arange(60)
    ticks = list(range(0, 181, 4))
    keys = [np.clip((t * 0.1 + 10 - x), 0, 1)[None].astype(np.float32) for t in ticks]  # to the right, 0.1 px a tick
    (_, image), *_ = exposures(keys, ticks, 180, 20_000)
    ramp = (image[0] > 0.02) & (image[0] < 0.98)
    assert abs(ramp.sum() - 0.1 * 167) <= 2
