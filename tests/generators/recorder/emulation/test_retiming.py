"""Spikes of cameras with other clocks, gains and bad pixels, against a float64 twin and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from spike4dgs.benchmark.scene.camera_state import Clock
from spike4dgs.benchmark.spikes.stream import pack
from spike4dgs.generators.recorder.emulation.imperfections import BadPixels, WorseCamera
from spike4dgs.generators.recorder.emulation.retiming import DWELL_TICKS, retimed, telegraph, with_current, worse_stream

WIDTH, HEIGHT, TICKS = 23, 5, 300
NONE = np.zeros(0, np.int64)
GOOD = BadPixels(NONE, NONE, NONE, np.zeros(0))


def steady(rates, n_ticks=TICKS):
    """Return spikes [T, H, W] of pixels at constant rates."""
    charge = np.arange(1, n_ticks + 1)[:, None] * rates.reshape(1, -1) + np.linspace(0, 0.99, rates.size)
    before = np.concatenate([np.linspace(0, 0.99, rates.size)[None], charge[:-1]])
    return (np.floor(charge) - np.floor(before)).astype(np.uint8).reshape(n_ticks, *rates.shape)


def unpacked(packed):
    bits = np.unpackbits(packed, axis=1, bitorder="little")[:, : WIDTH * HEIGHT]
    return bits.reshape(len(packed), HEIGHT, WIDTH)[:, ::-1]


def twin(fired, place, gain, clock):
    """Return the spikes [T] of one pixel, by interpolation of its charge over all levels, one spike after the other."""
    n, times = len(fired), [t + place for t in np.nonzero(fired)[0]]
    if not times:
        return np.zeros(n, np.uint8)
    first = max(times[1] - times[0], times[0] + 1e-6) if len(times) > 1 else n
    last = max(times[-1] - times[-2], n - times[-1]) if len(times) > 1 else n
    reach = 2 * n + 2 * abs(clock.offset_ticks)
    knots = [times[0] - reach, *times, times[-1] + reach]
    charges = [1 - reach / first, *range(1, len(times) + 1), len(times) + reach / last]
    begin = clock.shared(0)
    low = math.floor(gain * np.interp(begin, knots, charges))
    out, last_tick = np.zeros(n, np.uint8), -1
    levels = np.arange(low + 1, math.ceil(gain * charges[-1]))
    for tick in np.floor(clock.local(np.interp(levels / gain, charges, knots))).astype(int):
        chosen = max(tick, last_tick + 1)
        if 0 <= tick and chosen < n and chosen <= tick + 1:
            out[chosen], last_tick = 1, chosen
    return out


@pytest.mark.parametrize(
    ("gain", "offset", "drift"),
    [(1.0, 0.0, 0.0), (1.02, 0.0, 0.0), (0.97, 2.3, 0.0), (1.0, -3.7, 50.0), (1.4, 5.5, -5000.0), (0.6, -40.25, 9e3)],
)
def test_the_kernel_is_its_float64_twin(gain, offset, drift):
    rng = np.random.default_rng(3)
    light = np.clip(0.5 + 0.5 * np.sin(np.arange(TICKS) / 40), 0, 1)[:, None, None]
    spikes = (rng.random((TICKS, HEIGHT, WIDTH)) < light * rng.random((HEIGHT, WIDTH))).astype(np.uint8)
    spikes[:, 0, 0], spikes[:, 0, 1], spikes[:, 0, 2] = 0, 1, 0  # never, always, once
    spikes[17, 0, 2] = 1
    places, clock = rng.uniform(0.01, 0.99, HEIGHT * WIDTH), Clock(offset, drift)
    found = unpacked(retimed(pack(spikes), places, gain, clock))
    stored = places.reshape(HEIGHT, WIDTH)[::-1]
    expected = np.array(
        [[twin(spikes[:, y, x], stored[y, x], gain, clock) for x in range(WIDTH)] for y in range(HEIGHT)]
    )
    differs = (found != expected.transpose(2, 0, 1)).mean(axis=0)
    # A crossing at the very end of a tick may round to either side.
    assert differs.max() <= 4 / TICKS and (differs > 0).mean() < 0.05
    if gain == 1 and not offset:
        np.testing.assert_array_equal(found, spikes)


@pytest.mark.parametrize("gain", [0.5, 0.98, 1.02, 1.1])
def test_constant_light_fires_at_the_scaled_rate(gain):
    rates = np.linspace(0.02, 0.9, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    found = unpacked(retimed(pack(steady(rates)), np.full(rates.size, 0.5), gain, Clock()))
    assert np.abs(found.sum(axis=0) - TICKS * gain * rates).max() < 2
    full = unpacked(retimed(pack(np.ones((TICKS, HEIGHT, WIDTH))), np.full(rates.size, 0.5), gain, Clock()))
    assert np.abs(full.mean(axis=0) - min(gain, 1)).max() <= 1 / TICKS


@pytest.mark.parametrize("ticks", [-7, 3])
def test_an_offset_of_whole_ticks_shifts(ticks):
    spikes = (np.random.default_rng(1).random((TICKS, HEIGHT, WIDTH)) < 0.4).astype(np.uint8)
    found = unpacked(retimed(pack(spikes), np.full(HEIGHT * WIDTH, 0.3), 1.0, Clock(ticks)))
    inside = slice(max(ticks, 0), TICKS + min(ticks, 0))
    np.testing.assert_array_equal(found[inside], np.roll(spikes, ticks, axis=0)[inside])


def test_a_part_of_a_tick_shifts_that_part_of_the_pixels():
    spikes = steady(np.full((HEIGHT, WIDTH), 0.1))
    places = np.linspace(0, 1, HEIGHT * WIDTH + 2)[1:-1]
    found = unpacked(retimed(pack(spikes), places, 1.0, Clock(0.25)))
    moved = (found[20:-20] != spikes[20:-20]).any(axis=(0))
    assert abs(moved.mean() - 0.25) < 0.02


def test_a_drift_adds_up_over_the_clip():
    spikes = steady(np.full((HEIGHT, WIDTH), 0.2), 2000)
    found = unpacked(retimed(pack(spikes), np.full(HEIGHT * WIDTH, 0.5), 1.0, Clock(0, 1000.0)))
    for y, x in ((0, 0), (2, 11), (4, 22)):
        source, own = np.nonzero(spikes[:, y, x])[0], np.nonzero(found[:, y, x])[0]
        n = min(len(source), len(own))
        assert np.abs(own[:n] - 1.001 * source[:n]).max() <= 1


def test_a_current_adds_its_rate_and_saturates():
    rates = np.array([[0.0, 0.1, 0.5, 0.9]])
    spikes = steady(rates, 1000).reshape(1000, 4)
    found = with_current(spikes, np.full((1000, 4), 0.25)).sum(axis=0)
    expected = 1000 * np.minimum(rates[0] + 0.25, 1)
    assert np.abs(found.astype(float) - expected).max() <= 3  # the light after the last spike is not known
    np.testing.assert_array_equal(with_current(spikes, np.zeros((1000, 4))), spikes)


def test_flickering_changes_its_state_now_and_then():
    states = telegraph(20000, 40, np.random.default_rng(0))
    assert 0.4 < states.mean() < 0.6
    assert abs(np.abs(np.diff(states.astype(int), axis=0)).mean() * DWELL_TICKS - 1) < 0.05


def test_bad_pixels_lie_where_they_are_said_to_be():
    spikes = steady(np.full((HEIGHT, WIDTH), 0.3))
    bad = BadPixels(np.array([1]), np.array([WIDTH + 2, 40]), np.array([3 * WIDTH + 5]), np.array([0.5, 0.6, 0.4]))
    camera = WorseCamera(Clock(), 1.0, bad, np.eye(3), ())
    rate = unpacked(worse_stream(pack(spikes), WIDTH, HEIGHT, camera, 0, "cam_00", "clip")).mean(axis=0)
    assert rate[0, 1] == 0
    assert abs(rate[1, 2] - 0.8) < 0.03 and abs(rate[40 // WIDTH, 40 % WIDTH] - 0.9) < 0.03
    assert 0.31 < rate[3, 5] < 0.69
    rest = np.ones((HEIGHT, WIDTH), bool)
    rest.reshape(-1)[[1, WIDTH + 2, 40, 3 * WIDTH + 5]] = False
    np.testing.assert_array_equal(rate[rest], spikes.mean(axis=0)[rest])


def test_a_perfect_camera_sends_the_same_bytes():
    packed = pack(steady(np.full((HEIGHT, WIDTH), 0.3)))
    assert worse_stream(packed, WIDTH, HEIGHT, WorseCamera(Clock(), 1.0, GOOD, np.eye(3), ()), 0, "a", "clip") is packed
