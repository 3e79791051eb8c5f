"""What all speed measurements share: repeated timing, and a table on the console and in a CSV file."""

from __future__ import annotations

import csv
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from spike4dgs.benchmark.files import atomic_path


def time_ms(run: Callable[[], object], repeats: int) -> tuple[float, float]:
    """(minimum, median) wall time in ms of `repeats` calls, after one uncounted (compilation, page faults)."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append((time.perf_counter() - start) * 1e3)
    return min(times), statistics.median(times)


def show_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], csv_path: Path | None) -> None:
    """Print the rows, and write them to `csv_path` if given."""
    from rich.console import Console
    from rich.table import Table

    table = Table(*columns, title=title)
    for row in rows:
        table.add_row(*row)
    Console(width=max(Console().width, 120)).print(table)
    if csv_path is not None:
        with atomic_path(csv_path) as part, open(part, "w", newline="") as f:
            csv.writer(f).writerows([columns, *rows])
        print(f"written: {csv_path}")
