import math
import re

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.reports.html_chart import Axis, Curve, Dot, chart, scale_of, short


def dots(html: str) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', html)]


def test_points_stand_where_their_values_say_and_the_chosen_one_has_a_ring() -> None:
    curve = Curve("a", (Dot(1.0, 1e-4), Dot(10.0, 1e-3, "two", chosen=True), Dot(100.0, 1e-2)))
    html = chart([curve], Axis("ms"), Axis("error"), "time against error")
    (x0, y0), (x1, y1), (x2, y2) = dots(html)
    assert abs((x1 - x0) - (x2 - x1)) < 0.2 and abs((y0 - y1) - (y1 - y2)) < 0.2, "logarithms, larger is higher"
    assert html.count('class="ring"') == 1 and f'class="ring" cx="{x1:.1f}" cy="{y1:.1f}"' in html
    assert ">two</text>" in html and "<title>a: two: 10, 1e-3</title>" not in html and "a: two: 10, 0.001" in html
    assert 'aria-label="time against error"' in html and "legend" not in html


def test_names_never_lie_on_each_other() -> None:
    crowd = Curve("a", tuple(Dot(1.0 + 1e-3 * i, 1.0, f"setting {i}") for i in range(9)))
    html = chart([crowd], Axis("x", log=False), Axis("y", log=False), "a crowd")
    at = [(float(x), float(y)) for x, y in re.findall(r'<text class="halo" x="([\d.]+)" y="([\d.]+)"', html)]
    assert 1 <= len(at) < 9, "names that have no room are in the points' titles alone"
    assert all(abs(y - v) >= 11 or abs(x - u) > 50 for i, (x, y) in enumerate(at) for u, v in at[:i])
    assert all(f"setting {i}" in html for i in range(9))


def test_no_point_is_a_sentence() -> None:
    assert "Nothing was measured" in chart([Curve("a", ())], Axis("x"), Axis("y"), "nothing")


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
    assert scale_of([0.0, 0.0], log=True).at(0.0) == scale_of([2.0], log=False).at(0.0) == 0.0, "as a linear one"


@pytest.mark.parametrize(
    ("value", "shown"),
    [(0, "0"), (0.25, "0.25"), (12, "12"), (3000, "3000"), (2e-7, "2e-7"), (1234567, "1.2e6"), (-0.5, "-0.5")],
)
def test_numbers_are_short(value: float, shown: str) -> None:
    assert short(value) == shown
