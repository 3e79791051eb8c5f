"""Flickering light against closed forms and the lighting standards' figures."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from spike4dgs.generators.sensor.light import Flicker, FlickeringInstants, FlickeringMeans
from spike4dgs.generators.sensor.reference import tick_means

SINE, LED = Flicker(0.08, 100 / 20_000, 0.3), Flicker(0.9, 0.013, 0.6, duty=0.3)


@pytest.mark.parametrize("light", [SINE, LED])
def test_percent_flicker_and_mean_are_as_stated(light):
    ticks = np.arange(0, 40_000) / 97
    values = np.array([light.at(t) for t in ticks])
    assert (values.max() - values.min()) / (values.max() + values.min()) == pytest.approx(light.depth, rel=1e-4)
    period = 1 / light.per_tick
    assert quad(light.at, 0, period, limit=500)[0] / period == pytest.approx(1, abs=1e-3)


def test_the_flicker_index_of_a_sine_is_its_depth_over_pi():
    """IES: the share of the light of a period that lies above its mean."""
    values = np.array([SINE.at(t) for t in np.linspace(0, 200, 20_001)[:-1]])
    assert np.maximum(values - 1, 0).sum() / values.sum() == pytest.approx(SINE.depth / np.pi, rel=1e-3)


@pytest.mark.parametrize("light", [SINE, LED, Flicker(1.0, 3.7, 0.1, duty=0.2)])
def test_means_of_ticks_are_the_integrals(light):
    for tick in (0, 1, 17, 1999):
        fine = np.mean([light.at(tick + (k + 0.5) / 20_000) for k in range(20_000)])
        assert light.mean(tick) == pytest.approx(fine, abs=2e-4)


def test_a_clip_in_flickering_light_is_the_steady_one_times_its_factor():
    keys = np.random.default_rng(0).random((13, 3, 5)).astype(np.float32)

    def at(tick):
        return keys[tick]

    dense, means = FlickeringInstants(at, 12, SINE), FlickeringMeans(at, 12, SINE)
    assert (len(dense), len(means)) == (13, 12)
    for tick, steady in enumerate(tick_means(keys, list(range(13)), 12)):
        assert means[tick] == pytest.approx(steady * SINE.mean(tick), rel=1e-5)
        assert dense[tick] == pytest.approx(keys[tick] * SINE.at(tick), rel=1e-6)
    known = FlickeringMeans(at, 12, SINE, keys[:12] * 2)
    assert known[3] == pytest.approx(2 * keys[3] * SINE.mean(3), rel=1e-6)
