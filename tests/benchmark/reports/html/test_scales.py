from __future__ import annotations

import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.reports.html.scales import scale_of, short

POSITIVE = st.floats(1e-12, 1e12)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(POSITIVE, min_size=1, max_size=9), st.booleans(), st.booleans())
def test_places_keep_the_order_and_stay_inside(values: list[float], log: bool, zero: bool) -> None:
    values = sorted(values + [0.0] * zero)
    scale = scale_of(values, log)
    at = [scale.at(v) for v in values]
    assert at == sorted(at) and at[0] >= 0 and at[-1] <= 1


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(POSITIVE, min_size=1, max_size=9), st.booleans())
def test_ticks_are_few_and_on_the_axis(values: list[float], log: bool) -> None:
    scale = scale_of(values, log)
    ticks = scale.ticks()
    assert 1 <= len(ticks) <= 9
    assert all(-1e-6 <= scale.at(t) <= 1 + 1e-6 for t in ticks)


def test_a_logarithmic_axis_is_proportional_to_the_logarithm_and_shows_zeros_apart() -> None:
    scale = scale_of([0.0, 1e-4, 1e-2, 1.0], log=True)
    assert scale.at(0.0) == 0.0 and scale.at(1e-4) > 0.05
    assert math.isclose(scale.at(1.0) - scale.at(1e-2), scale.at(1e-2) - scale.at(1e-4))
    assert scale.ticks()[0] == 0.0


def test_an_axis_of_zeros_alone_is_linear() -> None:
    assert scale_of([0.0, 0.0], log=True).at(0.0) == 0.0
    assert scale_of([2.0], log=False).at(0.0) == 0.0


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0, "0"), (0.25, "0.25"), (12, "12"), (3000, "3000"), (2e-7, "2e-7"), (1234567, "1.2e6"), (-0.5, "-0.5")],
)
def test_numbers_are_short(value: float, shown: str) -> None:
    assert short(value) == shown
