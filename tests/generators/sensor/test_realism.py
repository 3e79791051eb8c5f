"""The simulated camera against published and measured statistics of a real one: each within 15 %.

- Adjacent intervals: a pixel that keeps the charge above the threshold and sees steady light has intervals of two
  neighbouring lengths between its spikes; one that drops the charge has one, one with much temporal noise has many.
  The share of pixels with other intervals grows with the noise of one spike, so it determines the number of photons
  per spike; it depends on the rates too, so recordings of equal rates and length are compared.
- Excess count variance: over windows of a recording, a pixel's count varies by f (1 - f) around its mean even without
  noise, f being the fraction of the mean; the unbiased variance of the counts minus that is temporal noise, plus
  f (1 - f) / (windows - 1) from the estimate itself, which a noise-free pixel shows too.
- Local gain spread: each pixel over the median of the 5x5 around it; the spread of that from its median absolute
  deviation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, median_filter
from small_scenes import shared_file

from spike4dgs.benchmark.scene.calibration import rates
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.benchmark.spikes.stream import open_stream
from spike4dgs.generators.sensor.calibration import dark_map, gain_map
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate

HEIGHT, WIDTH, TICKS = 250, 400, 500
# a motionless recording of a 250x400 camera, 500 frames
ONE_INTERVAL, TWO_INTERVALS, EXCESS = 0.016, 0.952, (0.0032, 0.0069, 0.0148, 0.0218)
GAIN_LOCAL, GAIN_SPREAD, DARK_PERCENTILES, HOT = 0.032, 0.058, (0.0015, 0.0045, 0.0128), 88
WITHIN = 0.15
WINDOWS = (10, 20, 40, 60)  # ticks


@dataclass(frozen=True)
class Statistics:
    one_interval: float  # share of pixels with intervals of one length
    two_intervals: float  # of exactly two neighbouring lengths
    other_intervals: float
    excess_variance: tuple[float, ...]  # for each of the WINDOWS


def stream_statistics(spikes: np.ndarray, pixels: np.ndarray | None = None) -> Statistics:
    """Return statistics of an unpacked recording [T, H, W], of those of `pixels` [H, W] with three spikes or more."""
    chosen = spikes.reshape(len(spikes), -1) if pixels is None else spikes[:, pixels]
    chosen = chosen[:, chosen.sum(0) >= 3]
    pixel, tick = np.nonzero(chosen.T)
    same = pixel[1:] == pixel[:-1]
    length, owner = np.diff(tick)[same], pixel[1:][same]
    shortest, longest = np.full(chosen.shape[1], len(chosen)), np.zeros(chosen.shape[1], np.int64)
    np.minimum.at(shortest, owner, length)
    np.maximum.at(longest, owner, length)
    one, two = float((shortest == longest).mean()), float((longest == shortest + 1).mean())
    return Statistics(one, two, 1 - one - two, tuple(excess_variance(chosen, window) for window in WINDOWS))


def excess_variance(spikes: np.ndarray, window: int) -> float:
    """Return the mean over the pixels of [T, P]: unbiased variance of the counts in windows, minus f (1 - f)."""
    n = len(spikes) // window
    counts = spikes[: n * window].reshape(n, window, -1).sum(1)
    fraction = counts.mean(0) % 1
    return float((counts.var(0, ddof=1) - fraction * (1 - fraction)).mean())


def local_spread(image: np.ndarray) -> float:
    """Return the robust relative spread of pixels [H, W] against their neighbours."""
    relative = image / median_filter(image, 5)
    return float(1.4826 * np.median(np.abs(relative - np.median(relative))))


def real_sensor(photons: float | None = SENSOR.photons_per_spike) -> Sensor:
    pixels = HEIGHT, WIDTH, 0, "cam_00"
    return Sensor(gain=gain_map(*pixels), dark=dark_map(*pixels), photons=photons, noise_seed=(0,))


def record(light: np.ndarray, sensor: Sensor, ticks: int = TICKS) -> np.ndarray:
    """Return unpacked spikes [T, H, W] of a static scene."""
    packed = [*simulate([light, light], [0, ticks], ticks, sensor, random_charge(*light.shape, [0]))]
    bits = np.unpackbits(np.concatenate(packed), axis=1, bitorder="little")[:, : light.size]
    return bits.reshape(ticks, *light.shape)[:, ::-1].astype(bool)


@pytest.fixture(scope="module")
def roadside() -> np.ndarray:
    """Smooth light with log-normal rates around 0.1 spikes per tick (98 % of the pixels between 0.04 and 0.26).

    The rates of the published recording are unknown. The share of pixels with one interval depends on little else, so
    it determines the median; the other figures are then predictions.
    """
    noise = gaussian_filter(np.random.default_rng(0).normal(size=(HEIGHT, WIDTH)), 12)
    return (0.1 / 0.6 * np.exp(0.4 * (noise - noise.mean()) / noise.std())).astype(np.float32)


def test_intervals_and_count_variance_are_the_real_cameras(roadside):
    found = stream_statistics(record(roadside, real_sensor()))
    assert found.one_interval == pytest.approx(ONE_INTERVAL, rel=WITHIN)
    assert found.two_intervals == pytest.approx(TWO_INTERVALS, rel=WITHIN)
    assert found.other_intervals == pytest.approx(1 - ONE_INTERVAL - TWO_INTERVALS, rel=WITHIN)
    assert found.excess_variance == pytest.approx(EXCESS, rel=WITHIN)


def test_wrong_cameras_are_distinguished(roadside):
    """Other simulators: a hard reset has one interval, Poisson noise on the gray level far too much variance."""
    rate = 0.6 * roadside.astype(np.float64)
    level, hard = np.random.default_rng(0).random(rate.shape), np.empty((TICKS, *rate.shape), bool)
    for tick in range(TICKS):
        level += rate
        hard[tick] = level >= 1
        level[hard[tick]] = 0
    assert stream_statistics(hard).two_intervals < 0.1
    noisy = record(roadside, real_sensor(photons=150))
    assert excess_variance(noisy.reshape(TICKS, -1), 60) > 1.5 * EXCESS[-1]


def test_maps_have_the_published_spreads():
    sensor = real_sensor()
    assert sensor.gain.mean() == pytest.approx(1, abs=1e-6)
    assert sensor.gain.std() == pytest.approx(GAIN_SPREAD, abs=0.002)
    assert local_spread(sensor.gain) == pytest.approx(GAIN_LOCAL, rel=WITHIN)
    smooth = sensor.gain.reshape(25, 10, 40, 10).mean((1, 3), keepdims=True)  # of blocks, another measure of it
    assert (sensor.gain.reshape(25, 10, 40, 10) / smooth).std() == pytest.approx(GAIN_LOCAL, rel=WITHIN)
    assert np.percentile(sensor.dark, (1, 50, 99)) == pytest.approx(DARK_PERCENTILES, rel=0.1)
    assert np.median(sensor.dark) == pytest.approx(DARK_PERCENTILES[1], rel=0.02)
    assert (sensor.dark > 5 * np.median(sensor.dark)).sum() == pytest.approx(HOT, rel=WITHIN)


def test_a_definition_of_excess_variance_against_its_closed_form():
    """Counts of an ideal pixel are one of two neighbours; the rest is the estimate's own f (1 - f) / (n - 1)."""
    rate, window, n = 0.237, 20, 25
    level = np.random.default_rng(0).random(4000)
    spikes = np.diff(np.floor(level + rate * np.arange(n * window + 1)[:, None]), axis=0).astype(bool)
    f = (rate * window) % 1
    assert excess_variance(spikes, window) == pytest.approx(f * (1 - f) / (n - 1), rel=0.05)


def test_static_pixels_of_a_real_recording_and_of_a_simulation_at_their_rates():
    stream = open_stream(shared_file("data/real_spikes/car_100kmh_250x400_200f.dat"), WIDTH, HEIGHT, 4e4)
    real = stream.window(0, stream.n_ticks).astype(bool)
    quarters = np.stack([gaussian_filter(part.mean(0), 2) for part in np.split(real, 4)])
    static = np.ptp(quarters, axis=0) < 0.004  # far from the car
    static &= (real.mean(0) > 0.05) & (real.mean(0) < 0.95)
    assert static.sum() > 5000
    light = (rates(stream) / 0.6).astype(np.float32)
    a = stream_statistics(real, static)
    ours = {n: stream_statistics(record(light, Sensor(photons=n), len(real)), static) for n in (2.5e4, 5e4, 1e5)}
    b = ours[SENSOR.photons_per_spike]
    assert b.one_interval == pytest.approx(a.one_interval, rel=WITHIN)
    assert b.two_intervals == pytest.approx(a.two_intervals, rel=WITHIN)
    assert b.other_intervals == pytest.approx(a.other_intervals, rel=WITHIN)
    assert b.excess_variance[: len(WINDOWS) - 1] == pytest.approx(a.excess_variance[: len(WINDOWS) - 1], rel=WITHIN)
    # twice or half as many photons per spike do not fit
    assert ours[1e5].other_intervals < 0.8 * a.other_intervals < 1.25 * a.other_intervals < ours[2.5e4].other_intervals


def test_measured_maps_and_ours_have_the_same_spread():
    with np.load(shared_file("data/real_spikes/calib_nonuniformity_250x400.npz")) as maps:
        light, dark, gain = maps["D_light"], maps["Nd"], maps["Nl"]
    sensor = real_sensor()
    assert robust_spread(sensor.gain) == pytest.approx(robust_spread(gain), rel=WITHIN)
    assert sensor.gain.std() == pytest.approx(gain.std() / gain.mean(), rel=WITHIN)
    assert local_spread(sensor.gain) == pytest.approx(local_spread(gain), rel=WITHIN)
    # `dark` is in lux, and the interval less one is inversely proportional to the light, which was 335 lux at `light`
    rate = 1 / (1 + light * (335 + dark) / dark)
    assert np.percentile(sensor.dark, (1, 50, 99)) == pytest.approx(np.percentile(rate, (1, 50, 99)), rel=WITHIN)
    ours, theirs = ((rates > 5 * np.median(rates)).sum() for rates in (sensor.dark, dark))
    assert ours == pytest.approx(theirs, rel=WITHIN)


def robust_spread(image: np.ndarray) -> float:
    return float(1.4826 * np.median(np.abs(image / np.median(image) - 1)))
