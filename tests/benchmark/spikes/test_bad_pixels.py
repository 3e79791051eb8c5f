"""Recordings with gaps have the bad pixels that whole ones have. See also `tests/cli/test_inspect.py`."""

from __future__ import annotations

import numpy as np
import pytest

from spike4dgs.benchmark.spikes.bad_pixels import find_bad
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.repair import fill_gaps
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.generators.sensor.calibration import gain_map

TICKS = 2000


def recorded(rate: np.ndarray, lost: int) -> SpikeStream:
    """Even spikes of rates [H, W], of which so many ticks from 700 on are lost."""
    charge, spikes = np.random.default_rng(0).random(rate.shape), np.empty((TICKS, *rate.shape), bool)
    for fired in spikes:
        charge += rate
        fired[:] = charge >= 1
        charge -= fired
    spikes[700 : 700 + lost] = False
    gaps = (Gap("cam_00", 700, lost, "overflow"),) if lost else ()
    return SpikeStream(pack(spikes), rate.shape[1], rate.shape[0], 2e4, gaps=gaps)


@pytest.mark.parametrize("lost", [0, 100, 600])
def test_a_hot_pixel_beside_a_gap_is_hot_and_does_not_flicker(lost: int) -> None:
    rate = 0.25 + 0.1 * np.sin(np.arange(40) / 9) * np.ones((24, 1))
    rate[11, 13] = 0.95
    stream = recorded(rate, lost)
    for found in (find_bad(stream), find_bad(fill_gaps(stream))):
        assert np.argwhere(found.hot).tolist() == [[11, 13]]
        assert not found.flickering.any() and not found.dead.any()


def test_pixels_of_unlike_gain_do_not_flicker_at_a_gap() -> None:
    rate = 0.6 * gain_map(125, 200, 0, "cam_00").astype(np.float64)
    assert not find_bad(recorded(rate, 600)).all.any()
