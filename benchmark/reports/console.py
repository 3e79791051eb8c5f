"""Results on the console: a table of all records, and one line per cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from spike4dgs.benchmark.metrics.metric import Metric
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.results.record import COSTS, Cell, Record


def make_console() -> Console:
    """Return a console; where the output is no terminal, it is wide enough for the table."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=240)


def results_table(records: Sequence[Record]) -> Table:
    """Return all records as a table: one block per scene and one for the mean; the best value of a block is bold.

    Metrics that no scene of any record has are left out.
    """
    splits = ", ".join(sorted({r["dataset"]["split"] for r in records}))
    cells = [cell for r in records for cell in r["scenes"].values()]
    metrics = [m for m in METRICS.values() if any(c["metrics"][m.id] is not None for c in cells)]
    lower = ", ".join(m.id for m in metrics if not m.higher_is_better)
    caption = f"higher is better{f', except {lower}' if lower else ''}; a dash is a value that does not exist"
    table = Table(title=f"Results, split {splits}", caption=caption, box=None)
    table.add_column("scene")
    table.add_column("method")
    for m in metrics:
        table.add_column(m.id.replace("_", "\n"), justify="right")
    for title, _ in COSTS.values():
        table.add_column(title.replace(", ", "\n"), justify="right")
    scenes = list(dict.fromkeys(s for r in records for s in r["scenes"]))
    for scene in scenes:
        named = [(r["method"]["name"], r["scenes"][scene]) for r in records if scene in r["scenes"]]
        _add_block(table, scene, metrics, [(name, cell["metrics"], cell) for name, cell in named])
    if len(scenes) > 1:
        _add_block(table, "mean", metrics, [(r["method"]["name"], r["mean"], {}) for r in records])
    return table


def _add_block(
    table: Table,
    title: str,
    metrics: Sequence[Metric],
    rows: list[tuple[str, dict[str, float | None], Mapping[str, Any]]],
) -> None:
    best: dict[str, float] = {}
    for m in metrics:
        known = [v for _, values, _ in rows if (v := values[m.id]) is not None]
        if known:
            best[m.id] = max(known) if m.higher_is_better else min(known)
    for i, (name, values, cell) in enumerate(rows):
        texts = []
        for m in metrics:
            text = m.format(values[m.id])
            texts.append(f"[bold]{text}[/bold]" if len(rows) > 1 and values[m.id] == best.get(m.id, "") else text)
        costs = ["" if cell.get(k) is None else f"{cell[k]:.{digits}f}" for k, (_, digits) in COSTS.items()]
        status = cell.get("status", "ok")
        shown = escape(name) + (f" [red]({status})[/red]" if status != "ok" else "")
        table.add_row(escape(title) if i == 0 else "", shown, *texts, *costs, end_section=i == len(rows) - 1)


def cell_summary(cell: Cell) -> str:
    """Return one line about a cell: its scores and costs, or why it has none."""
    if cell["status"] != "ok":
        return f"{cell['status']}: {cell['error']}"
    ids = ("psnr", "ssim", "psnr_dynamic", "ssim_dynamic", "flip")
    shown = [f"{k} {METRICS[k].format(cell['metrics'][k])}" for k in ids]
    costs = [("fit", "fit_seconds", "s"), ("render", "render_fps", "images/s"), ("peak", "peak_memory_mb", "MB")]
    shown += [f"{name} {cell[k]:.1f} {unit}" for name, k, unit in costs if cell[k] is not None]
    return ", ".join(shown)
