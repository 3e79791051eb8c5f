"""A camera's clock beside the array's."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from spike4dgs.benchmark.scene.camera_state import Clock


@given(
    offset=st.floats(-100, 100),
    drift=st.floats(-1000, 1000),
    tick=st.floats(0, 2_000_000),
)
def test_shared_undoes_local(offset: float, drift: float, tick: float) -> None:
    clock = Clock(offset, drift)
    assert abs(clock.shared(clock.local(tick)) - tick) < 1e-6


def test_a_fast_clock_gains_its_drift_in_a_second() -> None:
    assert abs(Clock(0.0, 50.0).local(20_000) - 20_001) < 1e-9
