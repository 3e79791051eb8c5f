"""The spike camera's model: the constants of the simulated cameras and one tick of a pixel.

In every tick a pixel gains charge: what its light asks for, times its relative sensitivity, plus its dark rate. Charge
is in units of the firing threshold. At charge 1 the pixel fires and loses the charge of one spike; the rest is kept
(subtractive reset). Shot noise makes the charge of each spike vary by 1 / sqrt(photons per spike).

The scenes' simulator (`generators.sensor`, integer charge) and the training windows of MSDI
(`method.msdi.training_data`, float64) follow this model and take its constants from here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

THRESHOLD = 2**31  # integer charge units in one threshold: the sign bit of a 32-bit sum is the spike
FULL_WELL = 1 - 1 / THRESHOLD  # thresholds: the most that a pixel holds after a tick; more is lost


@dataclass(frozen=True)
class SensorModel:
    """Constants of the simulated cameras.

    The spreads and rates follow calibrations of a real 250x400 spike camera. `tests/generators/sensor/test_realism.py`
    holds the simulator's statistics within 15 % of that camera's.
    """

    name: str = "integrate-and-fire/2"  # in scene.json
    reset: str = "subtractive"  # the real camera's intervals have two neighbouring lengths; a hard reset gives one
    most_spikes_per_tick: int = 1  # one bit a pixel is read out
    radiance_gain: float = 0.6  # spikes per tick of a pixel that sees white; above 1 a pixel is saturated

    # An effective number, fitted to a real camera's intervals: half and twice as many miss them by more than 20 %.
    # The capacitance that docs/sensor.md gives for reset noise would give 30,000 electrons.
    photons_per_spike: float = 5e4
    noise_cutoff: float = 3.46  # standard deviations; beyond it Gaussian shot noise is clipped

    gain_spread: float = 0.058  # standard deviation over the chip, most of it a smooth shading
    # From pixel to pixel. Robust spread against the median of 5x5: 3.2 % in a recording, 2.5 % in the real camera's
    # calibrated map, 2.8 % with this value.
    gain_local_spread: float = 0.0293

    dark_median: float = 0.0045  # spikes per tick
    dark_log_spread: float = 0.46  # log-normal: 1st to 99th percentile from 0.0015 to 0.0128
    hot_share: float = 9e-4  # about one pixel in a thousand is hot
    hot_factor: float = 5.0  # a hot pixel's dark rate is at least so many times its own log-normal one,
    hot_tail: float = 2.5  # beyond that a Pareto variable with this exponent,
    hot_most: float = 50.0  # and at most so many times


SENSOR = SensorModel()


LEAST_LIVE = 1 / 16  # of the time: a pixel that fires in every tick has seen at most 16 thresholds a tick
MOST_DEAD_TICKS = 10  # of a camera: up to 2.5 times white, `gathered` then finds the charge that `fired` was given


def gathered(rate: Any, dead_ticks: float) -> Any:
    """Return the charge per tick behind rates in spikes per tick: `rate` itself where no tick is dead.

    A pixel that collects no light for N ticks after each spike fires at r = x / (1 + N x) in light that gives it the
    charge x a tick. So x = r / (1 - N r): light is proportional to 1 / (interval - N), as far as N x is at most 15.

    >>> gathered(np.array([0.0, 1 / 3]), 1.0).round(6)
    array([0. , 0.5])
    """
    return rate / np.maximum(1 - dead_ticks * rate, LEAST_LIVE) if dead_ticks else rate


def fired(charge: Any, dead_ticks: float) -> Any:
    """Return the spikes per tick of pixels that gather `charge` a tick: the inverse of `gathered`, up to its bound."""
    return charge / (1 + dead_ticks * charge) if dead_ticks else charge


# The next two functions take scalars and arrays: NumPy runs them as they are, and numba compiles them for scalars.


def charge_of_tick(light: Any, dark: Any, most: Any) -> Any:
    """Return the charge that a tick adds, in [0, most]: `light` in spikes per tick, times sensitivity, plus `dark`.

    `most` is the largest charge that one spike takes. A saturated pixel fires in every tick and loses the surplus.
    """
    return np.minimum(np.maximum(light + dark, 0.0), most)


def charge_after_spike(charge: Any, spent: Any) -> Any:
    """Return the charge that remains when a spike takes `spent`: at most a full well."""
    return np.minimum(charge - spent, FULL_WELL)
