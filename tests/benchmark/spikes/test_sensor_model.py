"""The law of the sensor's charge: dead ticks, and the light that they hide."""

import numpy as np
import pytest

from spike4dgs.benchmark.spikes.sensor_model import MOST_DEAD_TICKS, SENSOR, fired, gathered


@pytest.mark.parametrize("dead_ticks", [0.0, 0.5, 1.0, 3.0, MOST_DEAD_TICKS])
def test_light_up_to_twice_white_is_recovered_whatever_ticks_are_dead(dead_ticks):
    charge = np.linspace(0, 2 * SENSOR.radiance_gain, 50)
    np.testing.assert_allclose(gathered(fired(charge, dead_ticks), dead_ticks), charge, atol=1e-12)
    assert np.isfinite(gathered(np.array([0.0, 0.5, 1.0]), dead_ticks)).all(), "a tick with a spike in each is no error"
    assert dead_ticks or gathered(charge, 0.0) is charge
