"""Results on the console: a table of all records, and one line per cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import stdev
from typing import Any, Literal

from rich.console import Console
from rich.markup import escape
from rich.segment import Segments
from rich.table import Table

from spike4dgs.benchmark.metrics.measure import mean
from spike4dgs.benchmark.metrics.metric import Metric
from spike4dgs.benchmark.metrics.table import MAIN, METRICS
from spike4dgs.benchmark.runs.record import COSTS, Cell, Record
from spike4dgs.benchmark.runs.refinement import is_refined

SHORT = (*MAIN, "fit_seconds", "render_fps")  # columns by default
WIDE = 240  # characters that hold every column
Columns = Literal["short", "all"]


def make_console() -> Console:
    """Return a console; where the output is no terminal, it is wide enough for the table."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=WIDE)


def results_table(records: Sequence[Record], every_column: bool = False) -> Table:
    """Return all records as a table: one block per scene and one for the mean; the best value of a block is bold.

    It has the columns `SHORT`, which fit 80 characters beside names of up to 30; with `every_column` all metrics that
    any record has, and all costs. Records of a method that differ only in the seed are one row, with means and sample
    standard deviations.
    """
    splits = ", ".join(sorted({r["dataset"]["split"] for r in records}))
    metrics, costs, blocks = blocks_of(records, every_column)
    lower = ", ".join(m.title for m in metrics if not m.higher_is_better)
    caption = f"higher is better{f', except {lower}' if lower else ''}; a dash is a value that does not exist"
    if len(seeds_of_methods(records)) < len(records):
        caption += "; mean ± standard deviation over the seeds, means of the costs"
    table = Table(title=f"Results, split {splits}", caption=caption, box=None, padding=(0, 0, 0, 1), pad_edge=False)
    table.add_column("method", no_wrap=True, overflow="fold")
    for m in metrics:
        table.add_column(_heading(m), justify="right")
    for key in costs:
        table.add_column(COSTS[key][0].replace(", ", "\n"), justify="right")
    for block in blocks:
        table.add_row(f"[italic]{escape(block.title)}[/italic]")
        for i, (name, values) in enumerate(block.rows, start=1):
            texts = [f"[bold]{text}[/bold]" if best else text for text, best in values]
            table.add_row(f" {escape(name)}", *texts, end_section=i == len(block.rows))
    return table


def cells_of(records: Sequence[Record]) -> list[Cell]:
    """Return the cells of all scenes of records."""
    return [cell for r in records for cell in r["scenes"].values()]


def print_results(console: Console, records: Sequence[Record], columns: Columns = "short") -> None:
    """Print the table of records; with all columns it may be wider than the console."""
    if columns == "all":
        options = console.options.update(width=max(console.width, WIDE))
        for line in console.render_lines(results_table(records, every_column=True), options, pad=False):
            console.print(Segments(line), soft_wrap=True)
    else:
        console.print(results_table(records))


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


@dataclass(frozen=True)
class Block:
    """Rows of methods on a scene, or of their means over all: each value as text, and whether it is the best."""

    title: str
    rows: Sequence[tuple[str, Sequence[tuple[str, bool]]]]


def blocks_of(
    records: Sequence[Record], every_column: bool = False
) -> tuple[Sequence[Metric], Sequence[str], list[Block]]:
    """Return the metrics and costs that a table of records shows, and its blocks; names say what failed."""
    cells = cells_of(records)
    metrics = [m for m in METRICS.values() if any(c["metrics"][m.id] is not None for c in cells)]
    costs = [key for key in COSTS if every_column or key in SHORT]
    if not every_column:
        metrics = [m for m in metrics if m.id in SHORT] or metrics  # a recording has other metrics than these
    methods, blocks = seeds_of_methods(records), []
    scenes = list(dict.fromkeys(s for r in records for s in r["scenes"]))
    for scene in scenes:
        named = [(m[0]["method"]["name"], [r["scenes"][scene] for r in m if scene in r["scenes"]]) for m in methods]
        rows = [_Row(name, [cell["metrics"] for cell in cells], cells) for name, cells in named if cells]
        blocks.append(_block(scene, metrics, costs, rows))
    if len(scenes) > 1:
        # Means over fewer scenes are not beside them.
        whole = [[r for r in m if set(scenes) <= r["scenes"].keys()] for m in methods]
        means = [_Row(m[0]["method"]["name"], [r["mean"] for r in m], cells_of(m)) for m in whole if m]
        blocks.append(_block(f"mean of {len(scenes)} scenes", metrics, costs, means))
    return metrics, costs, blocks


def _block(title: str, metrics: Sequence[Metric], costs: Sequence[str], rows: Sequence[_Row]) -> Block:
    best, ranked = dict[str, float](), [row for row in rows if not is_refined(row.name)]
    for m in metrics:
        known = [v for row in ranked if (v := row.mean(m.id)) is not None]
        if known and len(ranked) > 1:
            best[m.id] = max(known) if m.higher_is_better else min(known)
    made = []
    for row in rows:
        failed = sorted({cell["status"] for cell in row.cells} - {"ok"})
        values = [(row.text(m), not is_refined(row.name) and row.mean(m.id) == best.get(m.id, "")) for m in metrics]
        shown = [(row.cost(key, COSTS[key][1]), False) for key in costs]
        made.append((row.name + (f" ({', '.join(failed)})" if failed else ""), [*values, *shown]))
    return Block(title, made)


def _heading(metric: Metric) -> str:
    first, _, second = metric.id.partition("_")
    return f"{first}\n{second}"
