"""The scatter: labels can be read, and a floor does not set the axes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from pypdf import PdfReader

from spike4dgs.benchmark.reports.figure import method_color
from spike4dgs.benchmark.reports.scatter import floor_of, make_scatter, write_scatter

GOOD = {"tfi+4dgs": (31.5, 100), "tfp+4dgs": (33.7, 96), "spike4dgs": (36.3, 115), "spike4dgs-x": (40.3, 81)}
FLOOR = {"nearest-view": (15.4, 0.002), "tfp+static": (23.4, 58)}


def record(name: str, values: dict[str, tuple[float, float] | None]) -> dict[str, Any]:
    def cell(value: tuple[float, float] | None) -> dict[str, Any]:
        psnr, seconds = value or (None, None)
        return {"metrics": {"psnr": psnr, "psnr_dynamic": psnr and psnr - 5}, "fit_seconds": seconds}

    return {"method": {"name": name}, "scenes": {scene: cell(value) for scene, value in values.items()}}


def records(points: dict[str, tuple[float, float]]) -> list[dict[str, Any]]:
    return [record(n, {"a": (y - 0.5, x / 1.05), "b": (y + 0.5, x * 1.05)}) for n, (y, x) in points.items()]


def labels(axes: Axes) -> dict[str, Annotation]:
    return {t.get_text(): t for t in axes.texts if isinstance(t, Annotation) and t.get_text()}


def check_readable(figure: Figure) -> None:
    for axes in figure.axes:
        boxes = [(text, label.get_window_extent()) for text, label in labels(axes).items()]
        ticks = [(t.get_text(), t.get_window_extent()) for t in axes.get_xticklabels() if t.get_text()]
        assert len(ticks) >= 4
        for group in (boxes, ticks):
            for i, (text, a) in enumerate(group):
                assert not [other for other, b in group[i + 1 :] if a.overlaps(b)], text
        for text, box in boxes:
            assert axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1, text
            assert axes.bbox.y0 <= box.y0 and box.y1 <= axes.bbox.y1, text
        for text, box in ticks:
            assert 0 <= box.x0 and box.x1 <= figure.bbox.x1, text


def test_labels_of_many_methods_do_not_overlap() -> None:
    rng = np.random.default_rng(1)
    points = {f"images{i}+motion-{i}": (rng.normal(33, 1.5), 80 * rng.lognormal(0, 0.3)) for i in range(16)}
    figure = make_scatter(records(points))
    assert all(set(labels(axes)) == set(points) for axes in figure.axes)
    check_readable(figure)


def test_the_floor_is_on_the_edge_with_its_values_and_does_not_set_the_axes() -> None:
    with_floor, without = make_scatter(records({**FLOOR, **GOOD})), make_scatter(records(GOOD))
    check_readable(with_floor)
    for axes, other, shift in zip(with_floor.axes, without.axes, (0, 5), strict=True):
        low, high = axes.get_ylim()
        assert low > 25 - shift and high == pytest.approx(other.get_ylim()[1])
        inside = [y - shift for y, _ in GOOD.values()]
        assert (max(inside) - min(inside)) / (high - low) > 0.6, "the methods fill the axis"
        first, last = axes.get_xlim()
        assert first > 30 and last < 200, "and so does their time"
        found = labels(axes)
        assert set(found) >= set(GOOD)
        for name, (y, x) in FLOOR.items():
            assert f"{name}: {y - shift:.2f} dB, {x:g} s" in found
        arrows = [t for t in axes.texts if isinstance(t, Annotation) and t.arrow_patch and not t.get_text()]
        directions = [np.subtract(t.xy, t.get_position()) for t in arrows if t.xycoords == "axes fraction"]
        assert [tuple(np.sign(d)) for d in directions] == [(-1, -1), (0, -1)], "left and down, and down"


def test_one_dot_has_an_axis_of_a_decibel_whose_name_is_inside() -> None:
    figure = make_scatter([record("a", {"s": (31.2, 60)})])
    figure.canvas.draw()
    for axes, middle in zip(figure.axes, (31.2, 26.2), strict=True):
        low, high = axes.get_ylim()
        assert 1 < high - low < 1.3 and np.mean((low, high)) == pytest.approx(middle, abs=0.05)
        assert axes.yaxis.label.get_window_extent().x0 > 0


def test_a_time_of_nothing_is_below_the_least(tmp_path: Path) -> None:
    none = record("nearest-view", {"a": (15.0, 0.0), "b": (16.0, 0.0)})
    assert "nearest-view: 15.50 dB, <0.001 s" in labels(make_scatter([none, *records(GOOD)]).axes[0])


def test_each_scene_has_its_marker_and_each_method_its_colour() -> None:
    scenes = {f"scene {i} of many": (30.0 + i, 60.0) for i in range(14)}
    figure = make_scatter([record("a", scenes)])
    keys = figure.legends[0].legend_handles
    marks = {(key.get_marker(), key.get_markerfacecolor()) for key in keys}
    assert len(marks) == len(keys) == 15, "the mean's differs from all"
    figure.canvas.draw()
    legend = figure.legends[0].get_window_extent()
    assert not legend.overlaps(figure.axes[0].xaxis.label.get_window_extent())
    assert len({method_color(i) for i in range(60)}) > 50 and method_color(20) != method_color(0)


def test_methods_that_are_close_have_no_floor() -> None:
    assert floor_of([30.0, 30.1, 30.2, 29.5], 3) is None
    assert floor_of([20.0, 30.0], 3) is None, "one of two is not a floor"
    assert floor_of([12.0, 20.0, 30.0, 33.0, 36.0], 3) == 20.0
    axes = make_scatter(records(GOOD)).axes[0]
    assert axes.get_ylim()[0] < 31 and set(labels(axes)) == set(GOOD)


def test_a_mean_of_fewer_scenes_says_so_and_no_values_are_no_error() -> None:
    some = [record("whole", {"a": (30, 50), "b": (32, 60)}), record("part", {"a": (31, 55), "b": None})]
    assert set(labels(make_scatter(some).axes[0])) == {"whole", "part (1 of 2 scenes)"}
    some = [record("whole", {"a": (30, 50), "b": (32, 60)}), record("part", {"a": (31, 55)})]
    assert set(labels(make_scatter(some).axes[0])) == {"whole", "part (1 of 2 scenes)"}, "also where a record has none"
    assert not labels(make_scatter([record("none", {"a": None})]).axes[0])


def test_the_pdf_beside_has_the_names_as_text(tmp_path: Path) -> None:
    write_scatter(tmp_path / "scatter.png", records({**FLOOR, **GOOD}))
    text = PdfReader(tmp_path / "scatter.pdf").pages[0].extract_text()
    assert all(name in text for name in (*GOOD, *FLOOR, "fit time, s a scene", "mean over scenes"))
