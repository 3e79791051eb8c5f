"""What each rung of a ladder gains: on the console, as Markdown and CSV, and as a plot."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from spike4dgs.benchmark.files import write_text
from spike4dgs.benchmark.metrics.measure import mean
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.runs.record import Record

MEAN = "mean"
COLUMNS = {"psnr": "PSNR, dB", "psnr_dynamic": "PSNR where things move, dB", "fit_seconds": "fit, s"}
_GAINS = ("psnr", "psnr_dynamic")  # columns that are compared with the fit as it is


@dataclass(frozen=True)
class Cell:
    """A rung on a scene, or in the mean: values by `COLUMNS`, None where there is none, and why."""

    values: dict[str, float | None]
    error: str = ""


@dataclass(frozen=True)
class LadderTable:
    """The rungs of a method, the fit as it is first: title -> scene, or the mean -> cell."""

    method: str
    scenes: tuple[str, ...]
    rungs: dict[str, dict[str, Cell]]

    @property
    def places(self) -> tuple[str, ...]:
        """The scenes, and their mean where there are several."""
        return (*self.scenes, MEAN) if len(self.scenes) > 1 else self.scenes

    def gain(self, title: str, place: str, column: str) -> float | None:
        """Return by how much a rung is above the fit as it is; None where either has no value."""
        plain = next(iter(self.rungs.values()))[place].values[column]
        value = self.rungs[title][place].values[column]
        return None if plain is None or value is None else value - plain


def make_table(
    method: str, rungs: Sequence[tuple[str, str]], scenes: Sequence[str], records: Sequence[Record]
) -> LadderTable:
    """Return the table of the rungs (title, name of the record's method), each the mean over the seeds in `records`."""
    rows = {}
    for title, name in rungs:
        mine = [r for r in records if r["method"]["name"] == name]
        cells = {scene: _of_seeds([r["scenes"][scene] for r in mine]) for scene in scenes}
        every = {c: mean([cell.values[c] for cell in cells.values()]) for c in COLUMNS}
        rows[title] = {**cells, MEAN: Cell(every)}
    return LadderTable(method, tuple(scenes), rows)


def _of_seeds(cells: Sequence[dict[str, object]]) -> Cell:
    errors = [str(c["error"]) for c in cells if c["error"]]
    found = [{**dict.fromkeys(COLUMNS), **_metrics(c), "fit_seconds": c["fit_seconds"]} for c in cells]
    return Cell({name: mean([v[name] for v in found]) for name in COLUMNS}, "; ".join(errors))


def _metrics(cell: dict[str, object]) -> dict[str, object]:
    metrics = cell["metrics"]
    return {name: metrics[name] for name in _GAINS} if isinstance(metrics, dict) else {}


def write_ladder(out: Path, tables: Sequence[LadderTable]) -> None:
    """Write ladder.md and ladder.csv, and ladder_METHOD.png for each method."""
    write_text(out / "ladder.csv", to_csv(tables))
    write_text(out / "ladder.md", "\n".join(to_markdown(table) for table in tables))
    for table in tables:
        plot(out / f"ladder_{table.method}.png", table)


def to_csv(tables: Sequence[LadderTable]) -> str:
    """Return CSV: a line for each method, rung and scene, the mean included; gains are over the fit as it is."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["method", "rung", "scene", *COLUMNS, *(f"{c}_gain" for c in _GAINS), "error"])
    for table in tables:
        for title, cells in table.rungs.items():
            for place in table.places:
                values = [cells[place].values[c] for c in COLUMNS] + [table.gain(title, place, c) for c in _GAINS]
                numbers = ["" if v is None else f"{v:.4f}" for v in values]
                rows.writerow([table.method, title, place, *numbers, cells[place].error])
    return text.getvalue()


def to_markdown(table: LadderTable) -> str:
    """Return Markdown: a block for each column, its value and the gain in brackets, then errors."""
    lines = [f"# Where the dB of {table.method} are lost", ""]
    for title, header, body in _blocks(table):
        lines += [f"## {title}", "", _pipes(header), "|" + "---|" * len(header), *map(_pipes, body), ""]
    errors = [
        f"- {title}, {scene}: {cells[scene].error}"
        for title, cells in table.rungs.items()
        for scene in table.scenes
        if cells[scene].error
    ]
    return "\n".join([*lines, *errors, ""] if errors else lines)


def print_ladder(table: LadderTable, console: Console) -> None:
    """Print the same blocks."""
    for title, header, body in _blocks(table):
        shown = Table(title=f"{table.method}: {title}", box=None)
        for k, name in enumerate(header):
            shown.add_column(name.replace(" ", "\n") if k else name, justify="right" if k else "left")
        for row in body:
            shown.add_row(*row)
        console.print(shown)


def _blocks(table: LadderTable) -> list[tuple[str, list[str], list[list[str]]]]:
    """Return title, header and body of a block for each column."""
    header = ["rung", *table.places]
    return [
        (COLUMNS[c], header, [[title, *(_text(table, title, p, c) for p in table.places)] for title in table.rungs])
        for c in COLUMNS
    ]


def _text(table: LadderTable, title: str, place: str, column: str) -> str:
    value = table.rungs[title][place].values[column]
    if value is None:
        return "-"
    if column not in _GAINS:
        return f"{value:.0f}"
    gain = table.gain(title, place, column)
    return f"{value:.2f}" if gain is None or title == next(iter(table.rungs)) else f"{value:.2f} ({_signed(gain)})"


def _signed(gain: float) -> str:
    """Return a gain with its sign, which a rounded zero has none of: +0.00."""
    return f"{round(gain, 2) + 0.0:+.2f}"


def plot(path: Path, table: LadderTable) -> None:
    """Write a PNG: the gain of each rung on each scene, as colour and number, everywhere and where things move."""
    plain, *others = table.rungs
    places = table.places
    figure = new_figure((3.2 + 1.9 * len(others), 1.9 + 0.42 * len(places)))
    largest = max([abs(g) for t in others for p in places for c in _GAINS if (g := table.gain(t, p, c))], default=1.0)
    for axes, column in zip(figure.subplots(1, 2, sharey=True), _GAINS, strict=True):
        gains = [[_or_nan(table.gain(title, place, column)) for title in others] for place in places]
        axes.imshow(gains, cmap="RdBu", vmin=-largest, vmax=largest, aspect="auto")
        for y, row in enumerate(gains):
            for x, gain in enumerate(row):
                text, color = ("-", "black") if math.isnan(gain) else (_signed(gain), _ink(gain / largest))
                axes.text(x, y, text, ha="center", va="center", fontsize=8, color=color)
        axes.set_xticks(range(len(others)), [_folded(title) for title in others], fontsize=7)
        labels = [f"{p}: {_text(table, plain, p, _GAINS[0])} / {_text(table, plain, p, _GAINS[1])}" for p in places]
        axes.set_yticks(range(len(places)), labels, fontsize=8)
        if MEAN in places:
            axes.axhline(len(places) - 1.5, color="black", linewidth=1)
        axes.set_title(COLUMNS[column].replace("PSNR", "gain in PSNR"), fontsize=9)
    figure.suptitle(f"{table.method}: dB gained over the fit as it is (its PSNR / where things move)", fontsize=10)
    save_figure(figure, path)


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _ink(share: float) -> str:
    """Return the colour of text on a cell whose colour is `share` of the way to its end."""
    return "white" if abs(share) > 0.6 else "black"


def _folded(title: str) -> str:
    """Return a title in lines of about 14 letters."""
    lines = [""]
    for word in title.split():
        lines = [*lines[:-1], f"{lines[-1]} {word}".strip()] if len(lines[-1] + word) < 14 else [*lines, word]
    return "\n".join(lines)


def _pipes(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
