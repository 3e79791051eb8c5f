"""Progress of a run: bars with an estimate on a terminal, lines with one elsewhere; what came of each cell."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from spike4dgs.benchmark.metrics.table import MAIN, METRICS
from spike4dgs.benchmark.runs.record import Cell


@dataclass(frozen=True)
class ShownCell:
    """The callables to which a cell in progress reports."""

    progress: Callable[..., None]  # (done, total, note="")
    note: Callable[[str], None]


class RunDisplay:
    """Progress on the console: bars with an estimate on a terminal, lines with one elsewhere."""

    def __init__(self, console: Console, cells: int) -> None:
        self._console, self._cells, self._done, self._start = console, cells, 0, time.perf_counter()
        columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
        self._bars = Progress(TextColumn("{task.description}"), *columns, console=console, transient=True)
        self._all = self._bars.add_task("all cells", total=cells)

    def __enter__(self) -> RunDisplay:
        if self._console.is_terminal:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bars.stop()

    def say(self, text: str) -> None:
        """Print one line."""
        self._console.print(text, highlight=False, markup=False)

    @contextmanager
    def cell(self, title: str, notes: Sequence[str] = ()) -> Iterator[ShownCell]:
        """Show one cell with notes about it, and yield the callables to which it reports."""
        task = self._bars.add_task(title, total=None)
        label = f"[{self._done + 1}/{self._cells}] {title}"
        self.say(label)

        def progress(done: int, total: int, note: str = "") -> None:
            self._bars.update(task, completed=done, total=total, description=f"{title} {note}")
            self._bars.update(self._all, completed=self._done + min(done / max(total, 1), 1.0))

        def note(text: str) -> None:
            self.say(f"    {text}")

        for text in notes:
            note(text)
        yield ShownCell(progress, note)
        self._done += 1
        self._bars.remove_task(task)
        self._bars.update(self._all, completed=self._done)
        if left := self._cells - self._done:
            elapsed = time.perf_counter() - self._start
            note(f"{elapsed:.0f} s so far, about {elapsed / self._done * left:.0f} s to go")


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
