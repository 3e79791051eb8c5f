from __future__ import annotations

import re

from spike4dgs.benchmark.reports.html.chart import Axis, Curve, Dot, chart


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
