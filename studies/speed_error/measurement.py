"""What a room contributes to the report: measurements, each of one approximation or of one cost that grows.

A measurement's `run` yields series: the same settings on other inputs. Each setting is a point with a time (or memory)
and its errors against the exact twin; one of them is `exact`, and one is `chosen`, the project's own choice. Where a
cost grows with a size, there is no exact point, and the size stands where the time would.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

Size = Literal["tiny", "quick", "whole"]
Role = Literal["", "exact", "chosen"]
GROUPS = (  # of the page, in this order; the runner takes them in it too
    "Rasterizer",
    "Images from spikes",
    "Losses and networks",
    "Sensor and rendering",
    "Metrics and streams",
    "Fits",
    "How costs grow",
)


@dataclass(frozen=True)
class Column:
    """A value that each point has: the key in the JSON, the title with its unit, and whether a plot's axis is a log."""

    id: str
    title: str
    log: bool = True


MS = Column("ms", "time, ms")  # the best of several turns: other load on the machine only ever adds to a time
MEDIAN_MS = Column("median_ms", "median time, ms")


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
    """What a measurement may use: the size of its work, the seed, the device, and a scene, made when first asked."""

    size: Size
    seed: int
    device: str
    scene: Callable[[], Path]

    def pick(self, tiny: Any, quick: Any, whole: Any) -> Any:
        """Return the one of the values that belongs to the size."""
        return {"tiny": tiny, "quick": quick, "whole": whole}[self.size]


@dataclass(frozen=True)
class Measurement:
    """One section of the report. The texts are short sentences; words between backquotes are code."""

    id: str  # of its file and section: lower case, hyphens
    group: str  # of GROUPS
    title: str
    approximation: str
    exact: str  # the twin; empty where a cost grows
    reason: str  # of the chosen point
    columns: tuple[Column, ...]  # of every point, in the order of the table
    x: str  # of the plot, by column
    y: tuple[str, ...]  # a plot each
    run: Callable[[Request], Iterable[Series]] = field(compare=False)
    seconds: Mapping[str, float] = field(default_factory=dict)  # by size: what it took on two cores, for the estimate
    held_by: str = ""  # the test that holds the error
    cost: str = ""  # column of the summary, where it is not x
    error: str = ""  # column of the summary, where it is not the first of y
    sizes: tuple[Size, ...] = ("tiny", "quick", "whole")  # that it is part of

    def column(self, id: str) -> Column:
        """Return a column by its id."""
        return next(c for c in self.columns if c.id == id)
