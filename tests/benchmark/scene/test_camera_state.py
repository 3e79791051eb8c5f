"""A camera's state in an array: its clock, its gain, its bad pixels, and ticks of the array."""

from fractions import Fraction

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from spike4dgs.benchmark.scene.camera_state import Clock, local_tick, local_ticks, local_window


@given(offset=st.floats(-100, 100), drift=st.floats(-1000, 1000), tick=st.floats(0, 2_000_000))
def test_shared_undoes_local(offset: float, drift: float, tick: float) -> None:
    clock = Clock(offset, drift)
    assert abs(clock.shared(clock.local(tick)) - tick) < 1e-6


def test_the_nearest_tick_of_the_camera_is_taken() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        offset, ppm, tick = Fraction(int(rng.integers(-800, 800)), 4), int(rng.integers(-200, 200)), 12_345
        exact = offset + tick * (1 + Fraction(ppm, 1_000_000))
        assert abs(local_tick(Clock(float(offset), ppm), tick) - exact) <= Fraction(1, 2)


def test_a_perfect_clock_changes_nothing() -> None:
    assert local_ticks(Clock(), range(50), 50) == (list(range(50)), [True] * 50)
    assert all(local_window(Clock(), a, b, 50) == (a, b) for a in range(50) for b in range(a, 51))


def test_windows_keep_their_length_and_stay_in_the_clip() -> None:
    for offset in (-70.0, -3.4, 0.4, 12.0, 400.0):
        for start, stop in ((0, 40), (20, 60), (99, 100), (0, 100)):
            first, last = local_window(Clock(offset), start, stop, 100)
            assert last - first == stop - start and 0 <= first <= last <= 100
    assert local_window(Clock(12.0), 20, 60, 100) == (32, 72)
