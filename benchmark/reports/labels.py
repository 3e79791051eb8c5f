"""Labels of a plot that do not lie on each other, and ticks that can be read."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.transforms import Bbox

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
        label = axes.annotate(
            text, (x, y), xytext=(0, 0), textcoords="offset points", fontsize=7.5, annotation_clip=False
        )
        best = min(
            (_cost(axes, label, place, placed, marks), n, place) for n, place in enumerate(_places())
        )  # the first of equal ones
        _put(label, best[2])
        placed.append(label.get_window_extent().padded(PAD))
        if best[2][0] >= LED:
            axes.annotate(
                "", (x, y), xytext=label.get_position(), textcoords="offset points",
                arrowprops={"arrowstyle": "-", "linewidth": 0.5, "color": "0.5", "shrinkB": 3}, annotation_clip=False,
            )  # fmt: skip


def _places() -> Iterator[tuple[float, float]]:
    """Yield distance in points and direction in degrees, the best first."""
    for ring in RINGS:
        for direction in DIRECTIONS:
            yield float(ring), float(direction)


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
    """Return the area that two boxes share."""
    width, height = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
    return float(max(width, 0.0) * max(height, 0.0))


def log_ticks(low: float, high: float) -> list[float]:
    """Return 4 to 8 round numbers between two positive ends of a logarithmic axis.

    >>> log_ticks(40, 130)
    [40.0, 60.0, 80.0, 100.0, 120.0]
    >>> log_ticks(0.8, 90)
    [1.0, 2.0, 5.0, 10.0, 20.0, 50.0]
    """
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for steps in ((1, 2, 5), (1,)):
        found = [s * 10.0**e for e in decades for s in steps if low <= s * 10.0**e <= high]
        if 4 <= len(found) <= 8:
            return found
    if len(found) > 8:
        return found[:: math.ceil(len(found) / 8)]
    from matplotlib.ticker import MaxNLocator

    return [float(v) for v in MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high) if low <= v <= high]
