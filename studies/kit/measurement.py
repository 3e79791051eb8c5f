"""A measurement: one approximation beside its exact twin, or one cost that grows.

A measurement's `run` yields series: the same settings on other inputs. Each setting is a point with a time (or memory)
and its errors against the exact twin; one of them is `exact`, and one is `chosen`, the project's own choice. Where a
cost grows with a size, there is no exact point, and the size stands where the time would.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from spike4dgs.studies.kit.timing import by_turns_ms

Size = Literal["tiny", "quick", "whole"]
SIZES: tuple[Size, ...] = ("tiny", "quick", "whole")
Role = Literal["", "exact", "chosen"]
GROUPS = (  # of the page, in this order; the runner takes them in it too
    "Rasterizer",
    "Images from spikes",
    "Losses and networks",
    "Sensor and rendering",
    "Metrics and streams",
    "How costs grow",
)


@dataclass(frozen=True)
class Column:
    """A value that each point has: the key in the JSON, the title with its unit, and whether a plot's axis is a log."""

    id: str
    title: str
    log: bool = True


MS = Column("ms", "time, ms")  # the best of several turns: other load on the machine only ever adds to a time
TIMES = (MS, Column("median_ms", "median time, ms"))


@dataclass(frozen=True)
class Point:
    """One setting. A value that does not exist is None."""

    name: str
    values: Mapping[str, float | None]  # by column
    role: Role = ""


@dataclass(frozen=True)
class Series:
    """The points on one input, such as "20,000 random Gaussians" or "needles"."""

    name: str
    points: tuple[Point, ...]


@dataclass(frozen=True)
class Request:
    """What a measurement may use: the size of its work, the seed, and a scene, made when first asked."""

    size: Size
    seed: int
    scene: Callable[[], Path]

    def pick(self, tiny: Any, quick: Any, whole: Any) -> Any:
        """Return the one of the values that belongs to the size."""
        return {"tiny": tiny, "quick": quick, "whole": whole}[self.size]


Run = Callable[[Request], Iterable[Series]]


@dataclass(frozen=True)
class Measurement:
    """One section of a page. The texts are short sentences; words between backquotes are code."""

    id: str  # of its file and section: lower case, hyphens
    group: str  # of GROUPS
    title: str
    approximation: str
    exact: str  # the twin; empty where a cost grows
    reason: str  # of the chosen point
    columns: tuple[Column, ...]  # of every point, in the order of the table
    x: str  # of the plot, by column
    y: tuple[str, ...]  # a plot each
    run: Run = field(compare=False)
    held_by: str = ""  # the test that holds the error
    sizes: tuple[Size, ...] = SIZES  # that it is part of


def measurement(
    id: str,
    group: str,
    title: str,
    columns: tuple[Column, ...],
    y: tuple[str, ...],
    *,
    least: Size | None = "tiny",
) -> Callable[[Run], Measurement]:
    """Make a measurement of the decorated function; the paragraphs of its docstring are the texts.

    They are the approximation, the exact twin, the reason for the chosen point, and the test that holds the error;
    where a cost grows, the first alone. The first column is the x of plots. `least` is the smallest size that includes
    the measurement; with None it is measured only where it is asked for by its id.
    """
    sizes = SIZES[SIZES.index(least) :] if least else ()

    def made(run: Run) -> Measurement:
        paragraphs = [" ".join(p.split()) for p in (inspect.getdoc(run) or "").split("\n\n")]
        approximation, exact, reason, held_by = (*paragraphs, "", "", "")[:4]
        texts = approximation, exact, reason, columns, columns[0].id, y, run, held_by
        return Measurement(id, group, title, *texts, sizes)

    return made


def compared(
    name: str,
    calls: Mapping[str, Callable[[], Any]],
    errors: Callable[[Any, Any], Mapping[str, float | None]],
    turns: int,
    chosen: str = "",
    *,
    once: bool = False,
) -> Series:
    """Return the series of calls, which are timed by turns; the first is the exact one, with `once` timed once.

    `errors` returns the further values of a point from its result and the exact one.
    """
    runs = list(calls.values())
    start = time.perf_counter()
    exact = runs[0]()
    spent = 1e3 * (time.perf_counter() - start)
    times = [(spent, spent), *by_turns_ms(runs[1:], turns)] if once else by_turns_ms(runs, turns)
    points = []
    for title, run, (best, median) in zip(calls, runs, times, strict=True):
        values = errors(exact if run is runs[0] else run(), exact)
        role: Role = "exact" if run is runs[0] else "chosen" if title == chosen else ""
        points.append(Point(title, {"ms": best, "median_ms": median, **values}, role))
    return Series(name, tuple(points))


def timed(calls: Mapping[float, Callable[[], Any]], name: str, column: str, turns: int) -> Series:
    """Return the series of calls by their size, which goes into `column`; each is timed `turns` times, by turns."""
    times = zip(calls, by_turns_ms(list(calls.values()), turns), strict=True)
    points = (Point("", {column: size, "ms": best, "median_ms": median}) for size, (best, median) in times)
    return Series(name, tuple(points))


def max_rms(found: Any, exact: Any) -> dict[str, float]:
    """Return the largest and the RMS difference of two tensors of one shape, in float64."""
    error = (found.double() - exact.double()).abs()
    return {"max": float(error.max()), "rms": float(error.square().mean().sqrt())}
