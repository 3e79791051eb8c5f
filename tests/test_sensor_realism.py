"""The simulated camera against published and measured statistics of a real one: each within 15 %."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import shared_file
from scipy.ndimage import gaussian_filter

from spike4dgs.generators.sensor import PHOTONS_PER_SPIKE, Sensor, random_charge, simulate
from spike4dgs.generators.sensor_maps import dark_map, gain_map
from spike4dgs.generators.sensor_statistics import WINDOWS, excess_variance, local_spread, stream_statistics

HEIGHT, WIDTH, TICKS = 250, 400, 500
# a motionless recording of a 250x400 camera, 500 frames
TWO_INTERVALS, EXCESS = 0.952, (0.0032, 0.0069, 0.0148, 0.0218)
GAIN_LOCAL, GAIN_SPREAD, DARK_PERCENTILES, HOT = 0.032, 0.058, (0.0015, 0.0045, 0.0128), 88
WITHIN = 0.15


def real_sensor(photons: float | None = PHOTONS_PER_SPIKE) -> Sensor:
    pixels = HEIGHT, WIDTH, 0, "cam_00"
    return Sensor(gain=gain_map(*pixels), dark=dark_map(*pixels), photons=photons, noise_seed=(0,))


def record(light: np.ndarray, sensor: Sensor, ticks: int = TICKS) -> np.ndarray:
    """Unpacked spikes [T, H, W] of a scene that stands still."""
    height, width = light.shape
    packed = np.concatenate(
        list(simulate([light, light], [0, ticks], ticks, sensor, random_charge(height, width, [0])))
    )
    bits = np.unpackbits(packed, axis=1, bitorder="little")[:, : height * width]
    return bits.reshape(ticks, height, width)[:, ::-1].astype(bool)


@pytest.fixture(scope="module")
def roadside() -> np.ndarray:
    """Smooth light from shadow to near white, as a roadside has: rates of 0.06 to 0.55 spikes a tick."""
    noise = gaussian_filter(np.random.default_rng(0).normal(size=(HEIGHT, WIDTH)), 12)
    noise = (noise - noise.min()) / (noise.max() - noise.min())
    return (0.1 + 0.8 * noise).astype(np.float32)


def test_intervals_and_count_variance_are_the_real_cameras(roadside):
    found = stream_statistics(record(roadside, real_sensor()))
    assert found.two_intervals == pytest.approx(TWO_INTERVALS, rel=WITHIN)
    assert found.excess_variance == pytest.approx(EXCESS, rel=WITHIN)


def test_wrong_cameras_are_told_apart(roadside):
    """What other simulators do: a hard reset has one interval, Poisson on the gray level far too much variance."""
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
    assert sensor.gain.std() == pytest.approx(GAIN_SPREAD, rel=WITHIN)
    assert local_spread(sensor.gain) == pytest.approx(GAIN_LOCAL, rel=WITHIN)
    assert np.percentile(sensor.dark, (1, 50, 99)) == pytest.approx(DARK_PERCENTILES, rel=WITHIN)
    assert (sensor.dark > 5 * np.median(sensor.dark)).sum() == pytest.approx(HOT, rel=WITHIN)


def test_a_definition_of_excess_variance_against_its_closed_form():
    """Counts of an ideal pixel are one of two neighbours; the rest is the estimate's own f (1 - f) / (n - 1)."""
    rate, window, n = 0.237, 20, 25
    level = np.random.default_rng(0).random(4000)
    spikes = np.floor(level + rate * np.arange(1, n * window + 1)[:, None]) - np.floor(
        level + rate * np.arange(n * window)[:, None]
    )
    f = (rate * window) % 1
    assert excess_variance(spikes.astype(bool), window) == pytest.approx(f * (1 - f) / (n - 1), rel=0.05)


def test_still_pixels_of_a_real_recording_and_of_a_simulation_at_their_rates():
    raw = np.fromfile(shared_file("data/real_spikes/car_100kmh_250x400_200f.dat"), np.uint8)
    real = np.unpackbits(raw, bitorder="little").reshape(-1, HEIGHT, WIDTH)[:, ::-1].astype(bool)
    quarters = np.stack([gaussian_filter(part.mean(0), 2) for part in np.split(real, 4)])
    still = np.ptp(quarters, axis=0) < 0.004  # the car comes nowhere near
    still &= (real.mean(0) > 0.05) & (real.mean(0) < 0.95)
    assert still.sum() > 5000
    rate = gaussian_filter(real.mean(0), 0.7).astype(np.float32)
    ours = record((rate / 0.6).astype(np.float32), Sensor(photons=PHOTONS_PER_SPIKE, noise_seed=(1,)), len(real))
    a, b = stream_statistics(real, still), stream_statistics(ours, still)
    assert b.two_intervals == pytest.approx(a.two_intervals, rel=WITHIN)
    assert b.excess_variance[: len(WINDOWS) - 1] == pytest.approx(a.excess_variance[: len(WINDOWS) - 1], rel=WITHIN)


def test_measured_maps_and_ours_have_the_same_spread():
    with np.load(shared_file("data/real_spikes/calib_nonuniformity_250x400.npz")) as maps:
        light, dark, gain = maps["D_light"], maps["Nd"], maps["Nl"]
    sensor = real_sensor()
    spread = 1.4826 * np.median(np.abs(gain / np.median(gain) - 1))
    assert sensor.gain.std() == pytest.approx(spread, rel=WITHIN)
    # `dark` is in lux, and the interval less one is inversely proportional to the light, which was 335 lux at `light`
    rate = 1 / (1 + light * (335 + dark) / dark)
    assert np.percentile(sensor.dark, (1, 50, 99)) == pytest.approx(np.percentile(rate, (1, 50, 99)), rel=WITHIN)
