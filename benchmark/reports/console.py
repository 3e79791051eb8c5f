"""Results on the console: a table of all records, and one line per cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import stdev
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from spike4dgs.benchmark.metrics.measure import mean
from spike4dgs.benchmark.metrics.metric import Metric
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.runs.record import COSTS, Cell, Record


def make_console() -> Console:
    """Return a console; where the output is no terminal, it is wide enough for the table."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=240)


def results_table(records: Sequence[Record]) -> Table:
    """Return all records as a table: one block per scene and one for the mean; the best value of a block is bold.

    Records of a method that differ only in the seed are one row, with means and sample standard deviations. Metrics
    that no scene of any record has are left out.
    """
    splits = ", ".join(sorted({r["dataset"]["split"] for r in records}))
    cells = [cell for r in records for cell in r["scenes"].values()]
    metrics = [m for m in METRICS.values() if any(c["metrics"][m.id] is not None for c in cells)]
    lower = ", ".join(m.id for m in metrics if not m.higher_is_better)
    caption = f"higher is better{f', except {lower}' if lower else ''}; a dash is a value that does not exist"
    methods = seeds_of_methods(records)
    if len(methods) < len(records):
        caption += "; mean ± standard deviation over the seeds, means of the costs"
    table = Table(title=f"Results, split {splits}", caption=caption, box=None)
    table.add_column("scene")
    table.add_column("method")
    for m in metrics:
        table.add_column(m.id.replace("_", "\n"), justify="right")
    for title, _ in COSTS.values():
        table.add_column(title.replace(", ", "\n"), justify="right")
    scenes = list(dict.fromkeys(s for r in records for s in r["scenes"]))
    for scene in scenes:
        named = [(m[0]["method"]["name"], [r["scenes"][scene] for r in m if scene in r["scenes"]]) for m in methods]
        rows = [_Row(name, [cell["metrics"] for cell in cells], cells) for name, cells in named if cells]
        _add_block(table, scene, metrics, rows)
    if len(scenes) > 1:
        _add_block(table, "mean", metrics, [_Row(m[0]["method"]["name"], [r["mean"] for r in m]) for m in methods])
    return table


def seeds_of_methods(records: Sequence[Record]) -> list[list[Record]]:
    """Return the records in groups of one method, version, parameters and budget: those of its seeds."""
    groups: list[list[Record]] = []
    for record in records:
        for group in groups:
            method = group[0]["method"]
            if record["method"] | {"seed": None} == method | {"seed": None} and len(_budgets([*group, record])) <= 1:
                group.append(record)
                break
        else:
            groups.append([record])
    return groups


def _budgets(records: Sequence[Record]) -> set[Any]:
    return {cell["budget"] for r in records for cell in r["scenes"].values() if cell["status"] == "ok"}


@dataclass(frozen=True)
class _Row:
    """A method on a scene: what each of its seeds gave."""

    name: str
    values: Sequence[Mapping[str, float | None]]
    cells: Sequence[Cell] = ()

    def mean(self, metric: str) -> float | None:
        return mean(values[metric] for values in self.values)

    def text(self, metric: Metric) -> str:
        known = [v for values in self.values if (v := values[metric.id]) is not None]
        spread = f" ± {metric.format(stdev(known))}" if 1 < len(known) == len(self.values) else ""
        return metric.format(self.mean(metric.id)) + spread

    def cost(self, key: str, digits: int) -> str:
        value = mean(cell[key] for cell in self.cells)
        return "" if value is None else f"{value:.{digits}f}"


def _add_block(table: Table, title: str, metrics: Sequence[Metric], rows: Sequence[_Row]) -> None:
    best: dict[str, float] = {}
    for m in metrics:
        known = [v for row in rows if (v := row.mean(m.id)) is not None]
        if known:
            best[m.id] = max(known) if m.higher_is_better else min(known)
    for i, row in enumerate(rows):
        texts = []
        for m in metrics:
            text = row.text(m)
            texts.append(f"[bold]{text}[/bold]" if len(rows) > 1 and row.mean(m.id) == best.get(m.id, "") else text)
        costs = [row.cost(key, digits) for key, (_, digits) in COSTS.items()]
        failed = sorted({cell["status"] for cell in row.cells} - {"ok"})
        shown = escape(row.name) + (f" [red]({', '.join(failed)})[/red]" if failed else "")
        table.add_row(escape(title) if i == 0 else "", shown, *texts, *costs, end_section=i == len(rows) - 1)
