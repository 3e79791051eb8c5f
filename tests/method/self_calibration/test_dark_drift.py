"""Dark rates that changed since the calibration."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from warm_cameras import HEIGHT, WIDTH, maps, warm_scene

from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.method.self_calibration.dark_drift import dark_scale, in_todays_dark


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


def test_a_warm_camera_is_found_and_its_calibration_scaled():
    warm = warm_scene((1.0, 2.0))
    today = in_todays_dark(warm)
    first, second = (today.state(c.id) for c in warm.cameras)
    assert first.dark == 1 and second.dark == pytest.approx(2, abs=0.15)
    old, new = warm.calibrations, today.calibrations
    np.testing.assert_array_equal(new[0].dark, old[0].dark)
    np.testing.assert_allclose(new[1].dark, second.dark * old[1].dark, rtol=1e-6)
    np.testing.assert_array_equal(new[1].gain, old[1].gain)


def test_a_camera_as_it_was_stays_as_it_is():
    same = warm_scene((1.0, 1.0))
    assert in_todays_dark(same) is same
    bare = replace(same, recordings=())
    assert in_todays_dark(bare) is bare
