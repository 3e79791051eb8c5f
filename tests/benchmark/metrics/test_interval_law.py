"""The law of recorded intervals, beside brute force: the sensor's simulator, and integrals in long arithmetic."""

from __future__ import annotations

from itertools import pairwise

import mpmath
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from spike4dgs.benchmark.metrics.held_out_spikes import log_probability
from spike4dgs.benchmark.spikes.bits import unpack
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate
from spike4dgs.generators.sensor.reference import simulate_reference


def law(intervals: float, ticks: float, rate: float, tolerance: float, photons: float) -> float:
    arguments = (np.array([float(x)]) for x in (intervals, ticks, rate))
    return float(log_probability(*arguments, tolerance, photons)[0])


def frequencies(spikes: np.ndarray, intervals: int) -> dict[int, float]:
    """Return how often so many intervals after a spike lasted how many ticks, over all pixels of [T, P]."""
    lengths = [np.diff(np.flatnonzero(p)) for p in spikes.T]
    sums = [np.convolve(one, np.ones(intervals, int), "valid")[::intervals] for one in lengths if len(one) >= intervals]
    values, counts = np.unique(np.concatenate(sums), return_counts=True)
    return dict(zip(values.tolist(), (counts / counts.sum()).tolist(), strict=True))


@pytest.mark.parametrize(("rate", "intervals"), [(0.4137, 9), (0.0531, 1), (0.0731, 3), (0.93, 20)])
def test_the_sensor_follows_the_law(rate: float, intervals: int) -> None:
    photons = 2000.0  # much shot noise, so that lengths other than the two next to the mean occur
    sensor = Sensor(rate, photons=photons, noise_seed=(1,))
    ones, charge = np.ones((2, 30, 40), np.float32), random_charge(30, 40, [2])
    packed = np.concatenate(list(simulate(ones, [0, 400], 400, sensor, charge)))
    found = frequencies(unpack(packed, 40, 30, True)[20:].reshape(380, -1), intervals)
    expected = {m: np.exp(law(intervals, m, rate, 0.0, photons)) for m in found}
    # The law is linear in the rate, at the recorded one: m - n / rate is right to 1 / m, a twentieth and less.
    assert found == pytest.approx(expected, abs=0.05)
    assert sum(expected.values()) == pytest.approx(1, abs=0.06)


def test_the_sensors_slow_twin_follows_it_too_under_a_rate_that_is_not_known() -> None:
    rate, tolerance, photons, intervals = 0.31, 0.02, 5e4, 8
    rates = np.random.default_rng(0).normal(rate, tolerance, (20, 30)).astype(np.float32)
    sensor = Sensor(1.0, photons=photons, noise_seed=(3,))
    spikes = simulate_reference(rates[None].repeat(200, 0), range(200), 200, sensor, random_charge(20, 30, [4]), True)
    firsts = [np.flatnonzero(p)[: intervals + 1] for p in spikes[10:].reshape(190, -1).T]
    lengths = np.array([ticks[-1] - ticks[0] for ticks in firsts])
    edges = (0, 23, 25, 26, 28, 300)
    for low, high in pairwise(edges):
        expected = sum(np.exp(law(intervals, m, rate, tolerance, photons)) for m in range(max(low, 15), min(high, 60)))
        assert np.mean((lengths >= low) & (lengths < high)) == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("ticks", [29, 31, 32, 34])
def test_it_is_the_mean_over_rates_of_the_exact_law(ticks: int) -> None:
    intervals, rate, tolerance = 12, 0.38, 0.01

    def exact(r: float) -> float:
        return float(max(0.0, 1 - abs(ticks - intervals / r)) * norm.pdf(r, rate, tolerance))

    bends = [intervals / (ticks + x) for x in (-1, 0, 1)]
    found = np.exp(law(intervals, ticks, rate, tolerance, 1e12))
    assert found == pytest.approx(quad(exact, 0.2, 0.6, points=bends)[0], rel=0.15, abs=1e-4)


@pytest.mark.parametrize("offset", [0.0, 1e-6, 0.3, 0.999, 1.0, 1.001, 1.5, 4.0, 60.0, 2000.0])
@pytest.mark.parametrize("spread", [1e-3, 0.05, 0.4, 3.0, 800.0])
def test_its_logarithm_is_right_far_from_the_mean(offset: float, spread: float) -> None:
    """100 digits beside float64: E tri(d + s Z) by its second difference, from d = m (rate m / n - 1), n = m."""
    if offset / spread > 3e5:
        return  # of such errors there are none: rates lie in [0, 1], and the tolerance is a few percent of white
    with mpmath.workdps(100):
        s = mpmath.mpf(spread)

        def h(x: mpmath.mpf) -> mpmath.mpf:
            u = x / s
            return s * (u * mpmath.erfc(-u / mpmath.sqrt(2)) / 2 + mpmath.npdf(u))

        d = -mpmath.mpf(offset)
        exact = h(d + 1) - 2 * h(d) + h(d - 1)
        expected = float(mpmath.log(exact)) if exact > 0 else -np.inf
    if not np.isfinite(expected):
        return
    ticks = 7.0  # n = m: the recorded rate is 1, and s = tolerance * m
    found = law(ticks, ticks, 1 + offset / ticks, spread / ticks, np.inf)
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_it_is_finite_and_falls_with_the_error_everywhere() -> None:
    errors = np.linspace(0, 1, 200)
    for ticks, intervals in ((20, 20), (21, 12), (22, 2), (400, 1)):
        n, m = np.full(200, float(intervals)), np.full(200, float(ticks))
        for sign in (1, -1):
            values = log_probability(n, m, intervals / ticks + sign * errors, 0.018, 5e4)
            assert np.isfinite(values).all() and (np.diff(values) < 1e-9).all()
