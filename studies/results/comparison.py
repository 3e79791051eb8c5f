"""Rows compared over scenes: means, ranks with ties, and intervals of paired differences.

Intervals are those of the leaderboard's ranks (`leaderboard.page.intervals`): a paired bootstrap over worlds, their
variants and seeds, widened for few worlds. Those of a table's rows hold together with 95 %; that of a lead is of one
pair.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import fmean

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.variants import world_of
from spike4dgs.leaderboard.page.intervals import FEWEST_WORLDS, Comparison, compare
from spike4dgs.studies.results.records import Record

RANKED_BY = "psnr_dynamic"  # where things move is what the cameras are for
BOTH = ("psnr", RANKED_BY)  # of the whole image, and where things move


@dataclass(frozen=True)
class MeasuredRow:
    """The records of a row on some scenes. `seeds` are those that every scene has.

    A row with a cell that failed has no mean: without it, a row would gain by failing where it is bad.
    """

    name: str
    scenes: tuple[str, ...]
    cells: Mapping[tuple[str, int], Record]  # by scene and seed, those with metrics
    failed: Mapping[tuple[str, int], str] = field(default_factory=dict)  # why other cells have none

    @cached_property
    def seeds(self) -> tuple[int, ...]:
        """The seeds with which every scene was measured."""
        known = sorted({seed for _, seed in self.cells})
        return tuple(seed for seed in known if all((scene, seed) in self.cells for scene in self.scenes))

    @property
    def scenes_there(self) -> int:
        """The number of scenes with a measured cell."""
        return len({scene for scene, _ in self.cells})

    @property
    def is_complete(self) -> bool:
        """Return whether no cell failed, and some seed was measured on every scene with the metric of the ranks."""
        return self.values(RANKED_BY) is not None

    def values(self, metric: str) -> list[Float64] | None:
        """Return for each scene a metric's values [1, seeds]; None where one is missing, or a cell failed."""
        found = [
            [self.cells[scene, seed]["metrics"].get(metric) for seed in self.seeds] for scene in self.scenes
        ]  # fmt: skip
        if not self.seeds or self.failed or any(value is None for scene in found for value in scene):
            return None
        return [np.array([scene], dtype=np.float64) for scene in found]

    def mean(self, metric: str) -> float | None:
        """Return the mean over scenes of the means over seeds."""
        values = self.values(metric)
        return None if values is None else float(np.mean([scene.mean() for scene in values]))

    def variance(self, metric: str) -> float | None:
        """Return the variance between seeds, its mean over scenes; None where a value is missing, and for one seed."""
        values = self.values(metric)
        if values is None or len(self.seeds) < 2:
            return None
        return float(np.mean([np.var(scene, ddof=1) for scene in values]))

    def mean_cost(self, name: str) -> float | None:
        """Return the mean of a cost; None where a cell has none."""
        found = [self.cells[scene, seed].get(name) for scene in self.scenes for seed in self.seeds]
        costs = [cost for cost in found if cost is not None]
        return float(np.mean(costs)) if costs and len(costs) == len(found) else None

    @property
    def is_quiet(self) -> bool:
        """Return whether all times are of quiet passes."""
        return all(self.cells[scene, seed]["quiet"] for scene in self.scenes for seed in self.seeds)


@dataclass(frozen=True)
class Ranking:
    """Rows, best first, with the interval of each one's difference to the first, and its ranks."""

    rows: tuple[MeasuredRow, ...]
    behind: tuple[float, ...]  # of the first's mean
    half_widths: tuple[float, ...]
    ranks: tuple[str, ...]  # such as 1 or 2-4: what the intervals leave open


def rows_of(names: Iterable[str], scenes: Sequence[str], records: Iterable[Record]) -> list[MeasuredRow]:
    """Return the rows with these names, those without any measured cell among them."""
    cells: dict[str, dict[tuple[str, int], Record]] = {name: {} for name in names}
    failed: dict[str, dict[tuple[str, int], str]] = {name: {} for name in cells}
    for record in records:
        if record["row"] in cells and record["scene"] in scenes:
            key, error = (record["scene"], record["seed"]), record["error"]
            if error is None:
                cells[record["row"]][key] = record
            else:
                failed[record["row"]][key] = error
    return [MeasuredRow(name, tuple(scenes), found, failed[name]) for name, found in cells.items()]


def differences(one: MeasuredRow, other: MeasuredRow, metric: str) -> list[float]:
    """Return the first's mean over seeds less the other's for each scene of complete rows, their scenes in order."""
    pairs = zip(one.values(metric) or (), other.values(metric) or (), strict=True)
    return [float(a.mean() - b.mean()) for a, b in pairs]


def changes(row: MeasuredRow, other: MeasuredRow) -> list[float] | None:
    """Return by how much a row is ahead of another in the whole image and where things move, dB, means over scenes.

    None where either is incomplete.
    """
    if not (row.is_complete and other.is_complete):
        return None
    return [fmean(differences(row, other, metric)) for metric in BOTH]


def rank(rows: Sequence[MeasuredRow]) -> Ranking:
    """Return complete rows by the metric of the ranks, best first."""
    if not rows:
        return Ranking((), (), (), ())
    found = _compared(rows, RANKED_BY)
    order = np.argsort(-found.means, kind="stable")
    first = order[0]
    low, high = found.best_ranks, found.worst_ranks
    return Ranking(
        rows=tuple(rows[i] for i in order),
        behind=tuple(float(found.means[first] - found.means[i]) for i in order),
        half_widths=tuple(float(found.half_widths[first, i]) for i in order),
        ranks=tuple(str(low[i]) if low[i] == high[i] else f"{low[i]}-{high[i]}" for i in order),
    )


@dataclass(frozen=True)
class Lead:
    """How far a row is ahead of the best of others by a metric; negative where it is behind."""

    rival: str
    difference: float
    half_width: float

    @property
    def is_significant(self) -> bool:
        """Return whether the interval leaves out 0."""
        return abs(self.difference) > self.half_width


def lead(row: MeasuredRow, rivals: Sequence[MeasuredRow], metric: str) -> Lead | None:
    """Return the lead over the best of complete rivals; None where there is none with the metric."""
    known = [(mean, rival) for rival in rivals if (mean := rival.mean(metric)) is not None]
    if not known or row.mean(metric) is None:
        return None
    best = max(known, key=lambda pair: pair[0])[1]
    found = _compared([row, best], metric)
    return Lead(best.name, float(found.means[0] - found.means[1]), float(found.half_widths[0, 1]))


def _compared(rows: Sequence[MeasuredRow], metric: str) -> Comparison:
    values = [row.values(metric) for row in rows]
    worlds = list(map(world_of, rows[0].scenes))
    found = compare([v for v in values if v is not None], higher_is_better=True, worlds=worlds)
    if len(set(worlds)) >= FEWEST_WORLDS:
        return found
    # Of fewer worlds, images would be drawn, and a record has one value a scene: nothing is known.
    n = len(rows)
    half_widths = np.where(np.eye(n) > 0, 0.0, np.inf)
    return replace(found, half_widths=half_widths, better=np.zeros((n, n), np.bool_))
