"""What the held-out camera's own spikes say: the law of intervals, means over time, the view of a target."""

import math
from dataclasses import replace
from itertools import pairwise

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.stats import norm

from spike4dgs.benchmark import METRICS, SpikeStream
from spike4dgs.benchmark.metrics.held_out_spikes import (
    Recorded,
    Response,
    log_probability,
    record_around,
    response_of,
    time_mean,
    view_spikes,
)
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.spikes.bits import unpack
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.stream import pack
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
@pytest.mark.parametrize("spread", [1e-3, 0.05, 0.4, 3.0, 800.0, 9e3, 1.1e4, 1e6, 1e9])
def test_its_logarithm_is_right_far_from_the_mean(offset: float, spread: float) -> None:
    """100 digits beside float64: E tri(d + s Z) by its second difference, from d = m (rate m / n - 1), n = m."""
    offset *= max(1.0, spread / 1e3)  # wide ones matter far away
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
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-6 if spread < 1e3 else 1e-5)


def test_it_is_finite_and_falls_with_the_error_everywhere() -> None:
    errors = np.linspace(0, 1, 200)
    for ticks, intervals in ((20, 20), (21, 12), (22, 2), (400, 1)):
        n, m = np.full(200, float(intervals)), np.full(200, float(ticks))
        for sign in (1, -1):
            values = log_probability(n, m, intervals / ticks + sign * errors, 0.018, 5e4)
            assert np.isfinite(values).all() and (np.diff(values) < 1e-9).all()


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 60), min_size=1, max_size=5, unique=True), st.integers(0, 2**32 - 1))
def test_it_is_the_mean_of_a_dense_interpolation(ticks: list[int], seed: int) -> None:
    rng, ticks = np.random.default_rng(seed), sorted(ticks)
    images = rng.random((len(ticks), 2, 3))
    start = rng.uniform(-20, 60, (2, 3))
    stop = start + rng.uniform(1, 60, (2, 3))
    found = time_mean(ticks, list(images), start, stop)
    for index in np.ndindex(2, 3):
        times = start[index] + (np.arange(20000) + 0.5) / 20000 * (stop[index] - start[index])
        dense = np.interp(times, ticks, images[(slice(None), *index)])
        np.testing.assert_allclose(found[index], dense.mean(), atol=1e-6)


def test_one_window_for_all_pixels_and_images_that_stay_as_they_are() -> None:
    images = [np.full((2, 2), v) for v in (0.2, 0.6, 0.4)]
    before = [image.copy() for image in images]
    np.testing.assert_allclose(time_mean([0, 10, 20], images, 5, 15), np.full((2, 2), (0.5 + 0.55) / 2))
    np.testing.assert_allclose(time_mean([0, 10, 20], images, -9, -3), images[0])
    np.testing.assert_allclose(time_mean([0, 10, 20], images, 40, 50), images[2])
    np.testing.assert_array_equal(images, before)


Image = NDArray[np.floating]
HEIGHT, WIDTH, TICKS, TICK, GAIN = 40, 64, 200, 100, 0.6
SHAPE = (HEIGHT, WIDTH)
WHOLE = ("spike_psnr_5", "spike_psnr_20", "spike_psnr_80", "spike_deviance")
PLAIN = response_of(None, SHAPE, GAIN)


def filmed(radiance: Image, sensor: Sensor | None = None, seed: int = 0, n_ticks: int = TICKS) -> SpikeStream:
    """The stream of a camera under light that does not change."""
    sensor = sensor or Sensor(GAIN, photons=5e4, noise_seed=(seed,))
    keys = [radiance.astype(np.float32)] * 2
    packed = np.concatenate(list(simulate(keys, [0, n_ticks], n_ticks, sensor, random_charge(*SHAPE, [seed]))))
    return SpikeStream(packed, WIDTH, HEIGHT, 2e4)


def scores(recorded: Recorded, prediction: Image, truth: Image | None = None) -> dict[str, float | None]:
    """All scores of a prediction; the moving region is the left half."""
    moving = np.zeros(SHAPE, bool)
    moving[:, : WIDTH // 2] = True
    view = view_spikes(recorded, [TICK], [prediction], None if truth is None else [truth])
    pair = ImagePair(prediction if truth is None else truth, prediction, moving, "image", spikes=view)
    return {m.id: m.measure(pair) for m in METRICS.values() if m.takes == "spikes"}


def better(metric: str, a: float | None, b: float | None) -> bool:
    assert a is not None and b is not None
    return a > b if METRICS[metric].higher_is_better else a < b


@pytest.mark.parametrize("level", [0.1, 0.37, 0.71, 1.0])
@pytest.mark.parametrize("window", [5, 20, 80])
def test_the_right_level_leaves_the_noise_of_counting(level: float, window: int) -> None:
    """A counter that starts at any charge gives one of the two whole numbers around the mean: variance f (1 - f)."""
    image = np.full(SHAPE, level)
    sensor = Sensor(GAIN)  # no shot noise
    found = scores(record_around(filmed(image, sensor), TICK, PLAIN), image)[f"spike_psnr_{window}"]
    fraction = level * GAIN * window % 1
    noise = fraction * (1 - fraction) / (window * GAIN) ** 2
    assert found is not None
    if noise < 1e-9:
        assert found > 60
    else:
        assert found == pytest.approx(-10 * math.log10(noise), abs=0.8)


def test_a_wrong_level_adds_its_square() -> None:
    image = np.full(SHAPE, 0.5)  # 24 counts in 80 ticks, always
    recorded = record_around(filmed(image, Sensor(GAIN)), TICK, PLAIN)
    found = scores(recorded, image + 0.1)["spike_psnr_80"]
    assert found == pytest.approx(20, abs=0.05)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1.0]))
def test_the_truth_is_best_and_noise_makes_it_worse(seed: int, dead_ticks: float) -> None:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.02, 0.98) * np.ones(SHAPE) + rng.uniform(-0.3, 0.3, SHAPE)
    truth = np.clip(truth, 0, 1)
    sensor = Sensor(GAIN, photons=5e4, noise_seed=(seed % 1000,), dead_ticks=dead_ticks)
    response = response_of(None, SHAPE, GAIN, dead_ticks)
    recorded = record_around(filmed(truth, sensor, seed % 1000), TICK, response)
    noise = rng.normal(size=SHAPE)
    rows = [scores(recorded, truth + sigma * noise, truth) for sigma in (0, 0.06, 0.15, 0.4)]
    for metric in rows[0]:
        for good, bad in zip(rows[:-1], rows[1:], strict=True):
            assert better(metric, good[metric], bad[metric]), metric
    assert rows[0]["spike_deviance"] == rows[0]["spike_deviance_dynamic"] == 0


def test_without_the_truth_the_deviance_keeps_its_order_and_is_never_negative() -> None:
    truth = np.random.default_rng(0).uniform(0, 1, SHAPE)
    recorded = record_around(filmed(truth), TICK, PLAIN)
    predictions = [truth, truth + 0.03, 0.9 * truth, np.full(SHAPE, 0.5), np.zeros(SHAPE), np.ones(SHAPE)]
    own = [scores(recorded, p)["spike_deviance"] for p in predictions]
    excess = [scores(recorded, p, truth)["spike_deviance"] for p in predictions]
    differences = [a - b for a, b in zip(own, excess, strict=True) if a is not None and b is not None]
    assert min(v for v in own if v is not None) == own[0] and own[0] is not None and own[0] > 0
    np.testing.assert_allclose(differences, own[0], rtol=1e-9)  # the truth's own, the same for all


def test_light_above_white_counts_as_white() -> None:
    truth = np.full(SHAPE, 1.6)  # 0.96 spikes a tick
    recorded = record_around(filmed(truth), TICK, PLAIN)
    rows = [scores(recorded, np.full(SHAPE, level)) for level in (1.0, 1.6, 40.0, 0.9, 0.7)]
    for metric in WHOLE:
        values = [row[metric] for row in rows]
        assert values[0] == values[1] == values[2], "a prediction above white is white too"
        assert better(metric, values[0], values[3]) and better(metric, values[3], values[4])
    assert rows[0]["spike_psnr_80"] is not None and rows[0]["spike_psnr_80"] > 60  # 48 counts of white, to one


def test_gain_and_dark_maps_and_bad_pixels_come_from_the_recordings() -> None:
    rng = np.random.default_rng(1)
    gain = rng.normal(1, 0.1, SHAPE).astype(np.float32)
    gain /= gain.mean()
    dark = rng.uniform(0.002, 0.01, SHAPE).astype(np.float32)
    gain[3, 4], dark[5, 6] = 0, 0.3  # dead and hot
    dark[3, 4] = 0
    sensor = Sensor(GAIN, gain=gain, dark=dark)
    truth = rng.uniform(0.1, 0.9, SHAPE)
    even = (filmed(np.full(SHAPE, level), sensor, 7, 2000) for level in (0.7, 0.0))
    response = response_of(Recordings(*even, 0.7), SHAPE, GAIN)
    assert np.argwhere(~response.good).tolist() == [[3, 4], [5, 6]]
    np.testing.assert_allclose(response.white[response.good], GAIN * gain[response.good], rtol=0.01)
    stream = filmed(truth, sensor)
    known, unknown = (scores(record_around(stream, TICK, r), truth) for r in (response, PLAIN))
    for metric in WHOLE:
        assert better(metric, known[metric], unknown[metric])
    wrong = truth.copy()
    wrong[3, 4], wrong[5, 6] = 1, 0
    assert scores(record_around(stream, TICK, response), wrong) == known, "bad pixels are left out"


@pytest.mark.parametrize("camera_gain", [0.8, 1.1])
def test_a_camera_less_or_more_sensitive_than_the_array_is_judged_by_its_own_gain(camera_gain: float) -> None:
    sensor = Sensor(camera_gain * GAIN)
    even = (filmed(np.full(SHAPE, level), sensor, 7, 2000) for level in (0.7, 0.0))
    response = response_of(Recordings(*even, 0.7), SHAPE, GAIN)
    truth = np.random.default_rng(2).uniform(0.1, 0.8, SHAPE)
    own = scores(record_around(filmed(truth, sensor), TICK, response), truth)
    usual = scores(record_around(filmed(truth), TICK, PLAIN), truth)
    assert own["spike_psnr_80"] == pytest.approx(usual["spike_psnr_80"], abs=1.5)
    assert own["spike_deviance"] == pytest.approx(usual["spike_deviance"], abs=0.05)


def test_pixels_that_flicker_are_left_out() -> None:
    flat, dark = (filmed(np.full(SHAPE, level), Sensor(GAIN), 7, 2000) for level in (0.7, 0.0))
    spikes = unpack(flat.packed, WIDTH, HEIGHT, True)
    spikes[:, 2, 3] = (np.arange(2000) // 400) % 2  # off and on under steady light
    response = response_of(Recordings(replace(flat, packed=pack(spikes)), dark, 0.7), SHAPE, GAIN)
    assert np.argwhere(~response.good).tolist() == [[2, 3]]


def test_windows_that_lack_a_tick_have_no_score() -> None:
    truth = np.full(SHAPE, 0.5)
    stream = filmed(truth)
    near = replace(stream, gaps=(Gap("c", TICK + 30, 5, "lost"),))
    found = scores(record_around(near, TICK, PLAIN), truth, truth)
    assert {m for m, v in found.items() if v is None} == {"spike_psnr_80", "spike_psnr_80_dynamic"}
    hit = replace(stream, gaps=(Gap("c", TICK, 1, "lost"),))
    assert set(scores(record_around(hit, TICK, PLAIN), truth, truth).values()) == {None}
    edge = scores(record_around(stream, 9, PLAIN), truth, truth)
    assert {m for m, v in edge.items() if v is not None} == {"spike_psnr_5", "spike_psnr_5_dynamic"}


def test_pixels_without_an_interval_are_left_out_of_the_deviance() -> None:
    truth = np.full(SHAPE, 0.5)
    truth[:, :10] = 0  # these never fire
    recorded = record_around(filmed(truth), TICK, PLAIN)
    wrong = truth.copy()
    wrong[:, :10] = 1
    found, right = scores(recorded, wrong), scores(recorded, truth)
    assert found["spike_deviance"] == right["spike_deviance"]
    assert better("spike_psnr_20", right["spike_psnr_20"], found["spike_psnr_20"]), "the counts see them"


def test_motion_between_targets_is_in_the_expected_counts() -> None:
    """Light that rises steadily: images at its ends and the middle give the counts that the middle alone does not."""
    keys = [np.full(SHAPE, v, np.float32) for v in (0.2, 0.2, 0.8, 0.8)]
    charge = random_charge(*SHAPE, [3])
    packed = np.concatenate(list(simulate(keys, [0, 80, 110, 200], 200, Sensor(GAIN), charge)))
    recorded = record_around(SpikeStream(packed, WIDTH, HEIGHT, 2e4), TICK, PLAIN)
    level = float(np.interp(TICK, [80, 110], [0.2, 0.8]))
    images = [np.full(SHAPE, v) for v in (0.2, level, 0.8)]
    views = view_spikes(recorded, [80, 100, 110], images, None), view_spikes(recorded, [100], images[1:2], None)
    pairs = [ImagePair(images[1], images[1], np.ones(SHAPE, bool), "image", spikes=view) for view in views]
    for metric in ("spike_psnr_80", "spike_deviance"):
        moving, still = (METRICS[metric].measure(pair) for pair in pairs)
        assert better(metric, moving, still)


def test_a_response_never_fires_twice_in_a_tick() -> None:
    response = Response(np.full(SHAPE, 1.4), np.full(SHAPE, 0.1), 1.4, np.ones(SHAPE, bool))
    assert response.rate(np.ones(SHAPE)).max() == 1


def test_a_pixel_that_no_light_reaches_warns_of_nothing() -> None:
    stream = SpikeStream(pack(np.random.default_rng(0).random((200, *SHAPE)) < 0.3), SHAPE[1], SHAPE[0], 2e4)
    white, good = np.full(SHAPE, 0.5), np.ones(SHAPE, bool)
    white[0, 0], good[0, 0] = 0, False
    recorded = record_around(stream, 100, Response(white, np.zeros(SHAPE), 0.5, good))
    images = [np.full(SHAPE, 0.6, np.float32)] * 3
    found = view_spikes(recorded, [80, 100, 120], images, images).span_deviance
    assert found is not None and not found[1][0, 0] and np.isfinite(found[0][found[1]]).all()
