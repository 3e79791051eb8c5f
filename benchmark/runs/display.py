"""Progress of a run, with the time left, and what came of each cell."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from rich.console import Console

from spike4dgs.benchmark.metrics.table import MAIN, METRICS
from spike4dgs.benchmark.runs.record import Cell
from spike4dgs.benchmark.screen.bars import Pace, left_text, make_bars, seconds_text

_AROUND_S = 5.0  # of a cell beside its fit: the start of its process, renders, scores


@dataclass(frozen=True)
class ShownCell:
    """The callables to which a cell in progress reports."""

    progress: Callable[..., None]  # (done, total, note="")
    note: Callable[[str], None]


class RunDisplay:
    """Progress on the console: bars with an estimate on a terminal or in a notebook, lines with one elsewhere.

    `kinds` names what the cells' times go by, in their order, such as the methods: those that are fitted here one
    after another. Without it all cells count alike. `typical_s` holds seconds of some kinds on other machines: their
    ratios tell what a kind that was not met takes next to those that were.
    """

    def __init__(
        self, console: Console, cells: int, kinds: Sequence[str] = (), typical_s: Mapping[str, float] | None = None
    ) -> None:
        self._console, self._cells, self._kinds, self._done = console, cells, kinds, 0
        self._typical_s = typical_s or {}
        self._start = time.perf_counter()
        self._times: dict[str, list[float]] = {}  # of the cells in which something was fitted, by kind
        self._cell: tuple[float, Pace] | None = None  # of the one that is being fitted: since when
        self._bars = make_bars(console, transient=True)
        self._all = self._bars.add_task("all cells", total=cells, pace=self)

    def __enter__(self) -> RunDisplay:
        self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def say(self, text: str) -> None:
        """Print one line."""
        self._console.print(text, highlight=False, markup=False)

    def left(self) -> float | None:
        """Return the seconds left: of each cell those of earlier ones of its kind, or of all; None where none ended."""
        begun = self._done + (self._cell is not None)
        means = {kind: sum(known) / len(known) for kind, known in self._times.items()}
        of_cell = 0.0
        if self._cell:
            since, pace = self._cell
            if (of_stage := pace.left()) is None:
                return None
            elapsed, kind = time.perf_counter() - since, self._kind(self._done)
            of_cell = max(of_stage, means.setdefault(kind, elapsed + of_stage) - elapsed)
        kinds = [self._kind(k) for k in range(begun, self._cells)]
        if not means and not any(kind in self._typical_s for kind in kinds):
            return (time.perf_counter() - self._start) / self._done * len(kinds) if self._done else None
        return of_cell + sum(self._seconds(kind, means) for kind in kinds)

    def _kind(self, cell: int) -> str:
        return self._kinds[cell] if self._kinds else ""

    def _seconds(self, kind: str, means: Mapping[str, float]) -> float:
        """Return the seconds of a cell of a kind, from those of the kinds that were met."""
        if kind in means:
            return means[kind]
        typical = {k: s + _AROUND_S for k, s in self._typical_s.items()}
        met = [k for k in means if k in typical]
        pace = sum(means[k] for k in met) / sum(typical[k] for k in met) if met else 1.0
        of_other = sum(means.values()) / len(means) if means else 0.0
        return typical[kind] * pace if kind in typical else of_other

    @contextmanager
    def cell(self, title: str, notes: Sequence[str] = ()) -> Iterator[ShownCell]:
        """Show one cell with notes about it, and yield the callables to which it reports."""
        task = self._bars.add_task(title, total=None)
        self.say(f"[{self._done + 1}/{self._cells}] {title}")
        since, last = time.perf_counter(), 0

        def progress(done: int, total: int, note: str = "") -> None:
            nonlocal last
            if self._cell is None or total != last:
                last, self._cell = total, (since, Pace())
            self._cell[1].at(done, total)
            count = total if done else None  # a stage that has only begun has no count
            pace, shown = self._cell[1], f"{title} {note}"
            self._bars.update(task, total=count, completed=done, description=shown, pace=pace)
            self._bars.update(self._all, completed=self._done + min(done / max(total, 1), 1.0))

        def note(text: str) -> None:
            self.say(f"    {text}")

        for text in notes:
            note(text)
        yield ShownCell(progress, note)
        if self._cell:
            self._times.setdefault(self._kind(self._done), []).append(time.perf_counter() - since)
            self._cell = None
        self._done += 1
        self._bars.remove_task(task)
        self._bars.update(self._all, completed=self._done)
        if self._done < self._cells and (left := self.left()) is not None:
            elapsed = seconds_text(time.perf_counter() - self._start)
            note(f"{elapsed} so far, {left_text(left)}")


def metrics_summary(values: Mapping[str, float | None]) -> str:
    """Return the main metrics and their values as one line; all others where a recording has none of these."""
    known = [k for k in METRICS if values.get(k) is not None]
    shown = [k for k in MAIN if k in known] or known
    return ", ".join(f"{k} {METRICS[k].format(values[k])}" for k in shown)


def cell_summary(cell: Cell) -> str:
    """Return one line about a cell: its scores and costs, or why it has none."""
    if cell["status"] != "ok":
        return f"{cell['status']}: {cell['error']}"
    shown = [metrics_summary(cell["metrics"])]
    costs = [("fit", "fit_seconds", "s"), ("render", "render_fps", "images/s"), ("peak", "peak_memory_mb", "MB")]
    shown += [f"{name} {cell[k]:.1f} {unit}" for name, k, unit in costs if cell[k] is not None]
    return ", ".join(shown)
