"""The law of the sensor's charge: dead ticks, and the light that they hide."""

import numpy as np

from spike4dgs.benchmark.spikes.sensor_model import MOST_DEAD_TICKS, SENSOR, fired, gathered


def test_light_up_to_twice_white_is_recovered_whatever_ticks_are_dead():
    charge = np.linspace(0, 2 * SENSOR.radiance_gain, 50)
    np.testing.assert_allclose(gathered(fired(charge, MOST_DEAD_TICKS), MOST_DEAD_TICKS), charge, atol=1e-12)
