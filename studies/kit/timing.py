"""Repeated timing, and tables on the console, as CSV and as Markdown, for all studies."""

from __future__ import annotations

import csv
import io
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.files import write_text


def by_turns_ms(runs: Sequence[Callable[[], object]], repeats: int) -> list[tuple[float, float]]:
    """Return (minimum, median) wall time in ms of each run, after one uncounted call (compilation, page faults).

    They take turns, so that other load on the machine and its changing clock meet all of them alike.
    """
    for run in runs:
        run()
    times: list[list[float]] = [[] for _ in runs]
    for _ in range(repeats):
        for run, own in zip(runs, times, strict=True):
            start = time.perf_counter()
            run()
            own.append((time.perf_counter() - start) * 1e3)
    return [(min(own), statistics.median(own)) for own in times]


def show_table(
    title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], csv_path: Path | None, notes: Sequence[str] = ()
) -> None:
    """Print the rows, and write them to `csv_path` if given.

    `notes`, one a row or none at all, are printed below the table, and are the CSV file's last column `note`.
    """
    from rich.console import Console
    from rich.table import Table

    table = Table(*columns, title=title or None)
    for row in rows:
        table.add_row(*row)
    Console(width=max(Console().width, 120)).print(table)
    if notes:
        print("".join(f"{row[0]}: {note}\n" for row, note in zip(rows, notes, strict=True) if note), end="")
        columns = [*columns, "note"]
        rows = [[*row, note] for row, note in zip(rows, notes, strict=True)]
    if csv_path is not None:
        write_csv(csv_path, columns, rows)
        print(f"written: {csv_path}")


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a table as CSV atomically; None is an empty cell."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    write_text(path, text.getvalue())


def markdown(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table in Markdown."""
    return [f"| {' | '.join(cells)} |" for cells in (columns, ["---"] * len(columns), *rows)]
