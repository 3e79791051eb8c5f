"""One tick of the spike camera's model: for scalars, arrays and compiled code alike."""

from __future__ import annotations

import numpy as np
import pytest

from spike4dgs.benchmark.spikes.bits import kernel
from spike4dgs.benchmark.spikes.sensor_model import (
    FULL_WELL,
    MOST_DEAD_TICKS,
    SENSOR,
    charge_after_spike,
    charge_of_tick,
    fired,
    gathered,
)

TICKS = [(0.3, 0.01, 1.0, 0.31), (-0.2, 0.01, 1.0, 0.0), (3.0, 0.01, 1.25, 1.25)]
SPIKES = [(1.2, 1.0, 1.2 - 1.0), (1.25, 1.25, 0.0), (2.5, 1.0, FULL_WELL)]


@pytest.mark.parametrize(("function", "cases"), [(charge_of_tick, TICKS), (charge_after_spike, SPIKES)])
def test_scalars_arrays_and_compiled_code_agree(function, cases):
    *arguments, expected = np.array(cases).T
    np.testing.assert_array_equal(function(*arguments), expected)
    assert [function(*row) for row in zip(*arguments, strict=True)] == expected.tolist()
    compiled = kernel(function)
    assert [compiled(*row) for row in zip(*arguments, strict=True)] == expected.tolist()


def test_a_full_well_lies_one_unit_below_the_threshold():
    assert FULL_WELL == 1 - 2.0**-31


def test_light_up_to_twice_white_is_recovered_whatever_ticks_are_dead():
    charge = np.linspace(0, 2 * SENSOR.radiance_gain, 50)
    np.testing.assert_allclose(gathered(fired(charge, MOST_DEAD_TICKS), MOST_DEAD_TICKS), charge, atol=1e-12)
