"""Dark rates that changed since the calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.scene.calibration import Calibration, Recordings
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.self_calibration.dark_drift import dark_scale, in_todays_dark

HEIGHT, WIDTH, N = 60, 90, 1500


def maps(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rates by light, gains and dark rates [H, W] of a scene with edges, fine texture and flat parts."""
    rng = np.random.default_rng(seed)
    light = 0.2 + 0.1 * np.sin(np.arange(WIDTH) / 9.0)[None] * np.ones((HEIGHT, 1))
    light[10:30, 20:50] = 0.4
    light[30:] += rng.uniform(-0.05, 0.05, (HEIGHT - 30, WIDTH))
    gain = 1 + 0.06 * rng.normal(size=light.shape)
    return light, gain / gain.mean(), rng.gamma(3.0, 0.005 / 3, light.shape)


@given(scale=st.floats(0.0, 6.0), seed=st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_the_scale_of_exact_rates_is_within_its_error(scale, seed):
    light, gain, dark = maps(seed)
    known = Calibration(gain.astype(np.float32), dark.astype(np.float32), 0.6)
    found, error = dark_scale(light * gain + scale * dark, known)
    assert error < 0.1 and abs(found - scale) < 6 * error + 0.02


def test_dead_and_bright_pixels_do_not_matter():
    light, gain, dark = maps(1)
    gain[5, 5] = gain[40, 40:44] = 0.0
    dark[20, 70] = 0.5  # a hot pixel, no hotter than it was
    rate = light * gain + 2 * dark
    rate[20, 70] -= 0.5
    found, error = dark_scale(rate, Calibration(gain.astype(np.float32), dark.astype(np.float32), 0.6))
    assert abs(found - 2) < 6 * error


def test_cameras_that_say_nothing_have_no_scale():
    flat = np.ones((HEIGHT, WIDTH), np.float32)
    assert dark_scale(0.3 * flat.astype(np.float64), Calibration(flat, 0.005 * flat, 0.6))[0] == 1
    assert dark_scale(0.3 * flat.astype(np.float64), Calibration(0 * flat, 0.005 * flat, 0.6)) == (1.0, np.inf)


def stream_of(rates: np.ndarray, n_ticks: int, seed: int) -> SpikeStream:
    charge = np.random.default_rng(seed).uniform(0, 1, rates.shape)
    ticks = charge + rates * np.arange(1, n_ticks + 1)[:, None, None]
    spikes = np.diff(np.floor(ticks), axis=0, prepend=0) > 0
    return SpikeStream(pack(spikes.astype(np.uint8)), WIDTH, HEIGHT, 20_000.0)


def scene(scales: tuple[float, ...]) -> TrainingScene:
    streams, recordings = [], []
    for k, scale in enumerate(scales):
        light, gain, dark = maps(k)
        streams.append(stream_of(light * gain + scale * dark, N, k))
        flat, black = stream_of(0.42 * gain + dark, 500, 10 + k), stream_of(dark, 2000, 20 + k)
        recordings.append(Recordings(flat, black, 0.7))
    poses = (Camera(f"cam_{k:02d}", WIDTH, HEIGHT, 90, 90, 45, 30, np.eye(3), np.zeros(3)) for k in range(len(scales)))
    cameras = tuple(poses)
    return TrainingScene("s", "r", cameras, tuple(streams), 20_000.0, N, 0.6, recordings=tuple(recordings))


def test_a_warm_camera_is_found_and_its_calibration_scaled(capsys):
    warm = scene((1.0, 2.0))
    today = in_todays_dark(warm)
    first, second = (today.state(c.id) for c in warm.cameras)
    assert first.dark == 1 and second.dark == pytest.approx(2, abs=0.15)
    assert "1 of 2 cameras have " in capsys.readouterr().err
    old, new = warm.calibrations, today.calibrations
    np.testing.assert_array_equal(new[0].dark, old[0].dark)
    np.testing.assert_allclose(new[1].dark, second.dark * old[1].dark, rtol=1e-6)
    np.testing.assert_array_equal(new[1].gain, old[1].gain)


def test_a_camera_as_it_was_stays_as_it_is():
    same = scene((1.0, 1.0))
    assert in_todays_dark(same) is same
    bare = replace(same, recordings=())
    assert in_todays_dark(bare) is bare
