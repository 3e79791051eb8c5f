"""Scatter of quality against fit time, and plots of quality against the number of training views."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.figure import method_color, new_figure, save_with_pdf
from spike4dgs.benchmark.runs.record import Record

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

SHOWN = ("psnr", "psnr_dynamic")
MARKERS = "osD^vP*X<>hpd8"  # of scenes
LEAST_SECONDS = 1e-3  # a logarithm needs more than zero
CROWD = 30  # markers of scenes; more of them are paler
FAR = 0.75  # a gap of so much of the range of those above it makes those below it a floor...
FAR_DB, FAR_TIME = 3.0, math.log(10)  # ... if it is also as large as this


@dataclass(frozen=True)
class Point:
    """A method in the scatter: seconds and values of its scored scenes, and of them the means."""

    name: str
    color: Any
    scenes: dict[str, tuple[float, float]]
    of: int  # scenes of all records

    @property
    def x(self) -> float:
        """Mean of seconds, as the axis has it: geometric."""
        return math.exp(math.fsum(math.log(x) for x, _ in self.scenes.values()) / len(self.scenes))

    @property
    def y(self) -> float:
        """Mean of the metric."""
        return math.fsum(y for _, y in self.scenes.values()) / len(self.scenes)

    @property
    def label(self) -> str:
        """The name, and of how many scenes the means are where some are missing."""
        return self.name if len(self.scenes) == self.of else f"{self.name} ({len(self.scenes)} of {self.of} scenes)"


def write_scatter(path: Path, records: Sequence[Record]) -> None:
    """Write a PNG and a PDF: PSNR of the whole image and of the moving region against fit time.

    A colour is a method: a named ring is its mean over scenes, small markers are the scenes. A floor, methods far below
    all others, does not stretch the axes: it is on the edge, with an arrow and its values.
    """
    save_with_pdf(make_scatter(records), path)


def make_scatter(records: Sequence[Record]) -> Figure:
    """Return the scatter as a figure."""
    figure = new_figure((11, 4.6), None, dpi=160)
    markers = dict(zip(dict.fromkeys(s for r in records for s in r["scenes"]), itertools.cycle(MARKERS), strict=False))
    names = [*markers, "mean over scenes"]
    columns = max(1, min(len(names), int(150 / max(len(name) + 6 for name in names))))
    bottom = max(0.2, 0.13 + 0.035 * math.ceil(len(names) / columns))
    for n, metric in enumerate(SHOWN):
        axes = figure.add_axes((0.06 + 0.5 * n, bottom, 0.425, 0.97 - bottom))
        _panel(axes, metric, points_of(records, metric), markers)
    if len(markers) > 1:
        keys = [figure.axes[0].plot([], [], marker, color="0.45", ms=4, ls="")[0] for marker in markers.values()]
        keys.append(_ring(figure.axes[0], [], [], "0.45"))
        figure.legend(keys, names, loc="lower center", ncols=columns, fontsize=7.5, frameon=False)
    return figure


def points_of(records: Sequence[Record], metric: str) -> list[Point]:
    """Return the methods that have a value and a fit time of any scene."""
    found, scenes = [], {scene for record in records for scene in record["scenes"]}
    for i, record in enumerate(records):
        known = {
            scene: (max(cell["fit_seconds"], LEAST_SECONDS), cell["metrics"][metric])
            for scene, cell in record["scenes"].items()
            if cell["metrics"][metric] is not None and cell["fit_seconds"] is not None
        }
        if known:
            found.append(Point(record["method"]["name"], method_color(i), known, len(scenes)))
    return found


def floor_of(values: Sequence[float], least: float) -> float | None:
    """Return the largest of those values that lie far below all others; None where there are none.

    Far is a gap of `least`, and of `FAR` times the range of those above it, who must be the most.

    >>> floor_of([12.1, 16.4, 28.7, 29.5, 30.9, 36.0], 3)
    16.4
    >>> floor_of([28.7, 29.5, 30.9, 36.0], 3) is None
    True
    """
    ordered = sorted(values)
    found = None
    for k in range(1, (len(ordered) + 1) // 2):
        if ordered[k] - ordered[k - 1] >= max(least, FAR * (ordered[-1] - ordered[k])):
            found = ordered[k - 1]
    return found


def _panel(axes: Axes, metric: str, points: Sequence[Point], markers: Mapping[str, str]) -> None:
    title, unit = METRICS[metric].title, METRICS[metric].unit
    axes.set(xscale="log", xlabel="fit time, s a scene", ylabel=f"{title}, {unit}")
    axes.grid(alpha=0.3)
    if not points:
        return
    low = floor_of([p.y for p in points], FAR_DB)
    early = floor_of([math.log(p.x) for p in points], FAR_TIME)
    far = [p for p in points if (low is not None and p.y <= low) or (early is not None and math.log(p.x) <= early)]
    inside = [p for p in points if p not in far]
    # A method below the floor still sets the axis of time, if its time is like those of others.
    timed = [p for p in points if early is None or math.log(p.x) > early]
    _limits(axes, inside, timed, bool(far))
    strength = 0.75 if sum(len(p.scenes) for p in inside) <= CROWD else 0.4
    for point in inside:
        for scene, (x, y) in point.scenes.items():
            axes.plot(x, y, markers[scene], color=point.color, ms=4, alpha=strength, mew=0)
        _ring(axes, point.x, point.y, point.color)
    labels, tips = [(p.x, p.y, p.label) for p in inside], []
    for point in far:
        place, tip = _arrow(axes, point)
        labels.append((*place, _far_label(point, metric)))
        _ring(axes, *place, point.color, clip_on=False)
        tips.append(tip)
    label_points(axes, labels, [*(xy for p in inside for xy in p.scenes.values()), *tips])


def _ring(axes: Axes, x: Any, y: Any, color: Any, **style: Any) -> Any:
    """Draw the mark of a mean."""
    return axes.plot(x, y, "o", ms=8, mfc="none", mec=color, mew=2.2, ls="", **style)[0]


def _limits(axes: Axes, inside: Sequence[Point], timed: Sequence[Point], room: bool) -> None:
    """Set the axes' ends by the points inside; `room` leaves some for the floor at the lower edge."""
    xs = [x for p in inside for x, _ in p.scenes.values()] + [p.x for p in timed]
    ys = [y for p in inside for _, y in p.scenes.values()]
    wide, high = max(max(xs) / min(xs), 1.5), max(max(ys) - min(ys), 1.0)
    lack = (high - (max(ys) - min(ys))) / 2
    axes.set_xlim(min(xs) / wide**0.13, max(xs) * wide**0.13)
    axes.set_ylim(min(ys) - lack - (0.22 if room else 0.08) * high, max(ys) + lack + 0.1 * high)
    ticks = log_ticks(*axes.get_xlim())
    axes.set_xticks(ticks, labels=[f"{t:g}" for t in ticks])
    axes.set_xticks([], minor=True)


def _arrow(axes: Axes, point: Point) -> list[tuple[float, float]]:
    """Draw an arrow from inside the axes' edge towards a point beyond it; return where it begins, and its tip."""
    x, y = axes.transAxes.inverted().transform(axes.transData.transform((point.x, point.y)))
    start = (max(x, 0.045), max(y, 0.06))
    to = (start[0] - 0.04 * (x < start[0]), start[1] - 0.055 * (y < start[1]))
    style = {"arrowstyle": "-|>", "color": point.color, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9}
    axes.annotate("", to, xytext=start, xycoords="axes fraction", textcoords="axes fraction", arrowprops=style)
    return [tuple(axes.transData.inverted().transform(axes.transAxes.transform(end))) for end in (start, to)]


def _far_label(point: Point, metric: str) -> str:
    seconds = f"{point.x:.3g}" if point.x > LEAST_SECONDS * (1 + 1e-9) else f"<{LEAST_SECONDS:g}"
    return f"{point.label}: {METRICS[metric].format(point.y)} {METRICS[metric].unit}, {seconds} s"


def write_views(path: Path, table: Mapping[str, Any]) -> None:
    """Write a PNG and a PDF of a table whose columns are splits `views-N`: each metric against N, measured above."""
    metrics, scenes = [m["id"] for m in table["metrics"]], table["scenes"]
    figure = new_figure((3.4 * len(metrics), 6.4))
    axes = figure.subplots(2, len(metrics), squeeze=False)
    for row, kind in zip(axes, ("value", "published"), strict=True):
        for ax, metric in zip(row, metrics, strict=True):
            for i, method in enumerate(table["rows"]):
                cells = {int(s.split("-")[-1]): method["scenes"][k]["values"][metric][kind] for k, s in scenes.items()}
                known = {n: v for n, v in cells.items() if v is not None}
                if known:
                    ax.plot(known.keys(), known.values(), "o-", color=method_color(i), label=method["method"])
            ax.set_title(f"{METRICS[metric].title}, {'measured' if kind == 'value' else 'published'}", fontsize=9)
            ax.set_xlabel("training views")
            ax.set_visible(bool(ax.lines))
    handles = {label: h for ax in axes.flat for h, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if handles:
        figure.legend(handles.values(), handles.keys(), loc="outside right upper", fontsize=8)
    save_with_pdf(figure, path)


PAD = 1.5  # pixels between labels
MARK = 3.0  # points from a mark's centre to its edge
HIDDEN = 50  # what a covered mark costs, in pixels of overlap
RINGS = (9, 18, 30, 45, 65, 90, 120, 160)  # points from a mark to its label; a line leads to the farther ones
LED = 20  # points from which on there is such a line
DIRECTIONS = (0, 180, 90, 270, 45, 315, 135, 225)  # degrees, in order of preference: right, left, above, below


def label_points(axes: Axes, points: Sequence[tuple[float, float, str]], avoid: Sequence[tuple[float, float]]) -> None:
    """Write the label of each point (x, y, text), beside it and clear of other labels, of the points and of `avoid`.

    All are in data coordinates, and the axes' limits and place in the figure must be final. A label that has no room in
    the axes lies where it overlaps least.
    """
    to_pixels = axes.transData.transform
    marks = to_pixels([*((x, y) for x, y, _ in points), *avoid]) if points else np.empty((0, 2))
    placed: list[Bbox] = []
    for x, y, text in points:
        style: dict[str, Any] = {"textcoords": "offset points", "fontsize": 7.5, "annotation_clip": False}
        label = axes.annotate(text, (x, y), xytext=(0, 0), **style)
        places = itertools.product(RINGS, DIRECTIONS)  # the best first, and so the first of equal ones
        best = min(places, key=lambda place: _cost(axes, label, place, placed, marks))
        _put(label, best)
        placed.append(label.get_window_extent().padded(PAD))
        if best[0] >= LED:
            line = {"arrowstyle": "-", "linewidth": 0.5, "color": "0.5", "shrinkB": 3}
            axes.annotate("", (x, y), xytext=label.get_position(), arrowprops=line, **style)


def _put(label: Any, place: tuple[float, float]) -> None:
    """Move a label's anchor: a label on the right starts there, one on the left ends there."""
    ring, angle = place[0], math.radians(place[1])
    dx, dy = ring * math.cos(angle), ring * math.sin(angle)
    label.set_position((dx, dy))
    label.set_ha("center" if abs(dx) < 1 else "left" if dx > 0 else "right")
    label.set_va("center" if abs(dy) < 1 else "bottom" if dy > 0 else "top")


def _cost(axes: Axes, label: Any, place: tuple[float, float], placed: Sequence[Bbox], marks: Any) -> float:
    """Return how bad a place is: pixels of overlap with labels and of what lies outside the axes, and marks hidden."""
    _put(label, place)
    box = label.get_window_extent().padded(PAD)
    cost = sum(_overlap(box, other) for other in placed)
    cost += box.width * box.height - _overlap(box, axes.bbox)
    wide = box.padded(MARK * axes.figure.dpi / 72)
    inside = (marks[:, 0] > wide.x0) & (marks[:, 0] < wide.x1) & (marks[:, 1] > wide.y0) & (marks[:, 1] < wide.y1)
    return float(cost + HIDDEN * inside.sum())


def _overlap(a: Bbox, b: Bbox) -> float:
    width, height = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
    return float(max(width, 0.0) * max(height, 0.0))


def log_ticks(low: float, high: float) -> list[float]:
    """Return 4 to 8 round numbers between two positive ends of a logarithmic axis.

    >>> log_ticks(40, 130)
    [40.0, 60.0, 80.0, 100.0, 120.0]
    >>> log_ticks(0.8, 90)
    [1.0, 2.0, 5.0, 10.0, 20.0, 50.0]
    >>> log_ticks(0.8, 900)
    [1.0, 5.0, 10.0, 50.0, 100.0, 500.0]
    """
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for steps in ((1, 2, 5), (1, 5), (1,)):
        found = [s * 10.0**e for e in decades for s in steps if low <= s * 10.0**e <= high]
        if 4 <= len(found) <= 8:
            return found
    if len(found) > 8:
        return found[:: math.ceil(len(found) / 8)]
    from matplotlib.ticker import MaxNLocator

    return [float(v) for v in MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high) if low <= v <= high]
