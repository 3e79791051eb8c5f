"""A table of methods and scenes as Markdown, CSV, LaTeX and JSON; the best value is bold, the second underlined."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.files import write_json, write_text
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.runs.record import COSTS

Table = Mapping[str, Any]  # from `paper_tables.build_table`
Mark = Callable[[str, int], str]  # text of a value, its rank (0 best, 1 second) -> marked text


def write_table(folder: Path, table: Table) -> None:
    """Write table.md, .csv, .tex and .json to `folder`."""
    write_json(folder / "table.json", dict(table))
    write_text(folder / "table.csv", to_csv(table))
    write_text(folder / "table.md", to_markdown(table))
    write_text(folder / "table.tex", to_latex(table))


def to_csv(table: Table) -> str:
    """Return CSV with one line for every method, scene and metric."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["method", "scene", "metric", "value", "published", "reason", *COSTS])
    for row in table["rows"]:
        for scene, cell in row["scenes"].items():
            costs = [_number(cell[k], "{:.6g}") for k in COSTS]
            for metric, v in cell["values"].items():
                value, printed = _number(v["value"], "{:.6g}"), _number(v["published"], "{:g}")
                writer.writerow([row["method"], scene, metric, value, printed, v["reason"] or "", *costs])
    return out.getvalue()


def to_markdown(table: Table) -> str:
    """Return Markdown: means with costs and ranks, a block for each metric with all scenes, then missing values."""
    marks: Mark = lambda text, rank: (f"**{text}**", f"<u>{text}</u>")[rank]  # noqa: E731
    lines = [f"# Table {table['table']}: {table['title']}", "", f"Published columns: {table['published_note']}", ""]
    for title, header, body in (_summary(table, marks), *_metric_blocks(table, marks)):
        lines += [f"## {title}", "", _pipes(header), _pipes(["---"] * len(header)), *map(_pipes, body), ""]
    if reasons := _reasons(table):
        lines += ["## Values that do not exist", "", *(f"- {r}" for r in reasons), ""]
    return "\n".join(lines)


def to_latex(table: Table) -> str:
    """Return LaTeX: the same blocks as `tabular`s for the package booktabs."""
    marks: Mark = lambda text, rank: (rf"\textbf{{{text}}}", rf"\underline{{{text}}}")[rank]  # noqa: E731
    lines = []
    for title, header, body in (_summary(table, marks), *_metric_blocks(table, marks)):
        lines += [f"% {title}", rf"\begin{{tabular}}{{l{'r' * (len(header) - 1)}}}", r"\toprule"]
        lines += [_ampersands(header), r"\midrule", *map(_ampersands, body), r"\bottomrule", r"\end{tabular}", ""]
    return "\n".join(lines)


def _summary(table: Table, mark: Mark) -> tuple[str, list[str], list[list[str]]]:
    """Return the block of means over scenes: each metric, its published mean and both ranks, then the costs."""
    header, columns = ["method"], [[r["method"] for r in table["rows"]]]
    for m in table["metrics"]:
        cells = [r["mean"][m["id"]] for r in table["rows"]]
        header.append(m["title"])
        columns.append(_marked([c["value"] for c in cells], m["id"], mark))
        if any(c["published"] is not None for c in cells):
            header += [f"{m['title']}, published", "rank / published"]
            columns.append([METRICS[m["id"]].format(c["published"]) for c in cells])
            columns.append([f"{c['rank'] or '-'} / {c['published_rank'] or '-'}" for c in cells])
    for cost, (title, digits) in COSTS.items():
        header.append(title)
        columns.append([_number(r["costs"][cost], f"{{:.{digits}f}}") or "-" for r in table["rows"]])
    taus = "; ".join(f"{METRICS[m].title} {t:.2f}" for m, t in table["agreement"].items() if t is not None)
    title = "Mean over scenes" + (f" (Kendall's tau with the published order: {taus})" if taus else "")
    return title, header, [list(row) for row in zip(*columns, strict=True)]


def _metric_blocks(table: Table, mark: Mark) -> list[tuple[str, list[str], list[list[str]]]]:
    """Return one block for each metric: all scenes, and the ground truth's own score where the metric has one."""
    blocks = []
    for m in table["metrics"]:
        scored = any(m["id"] in values for values in table["truth"].values())
        last = ["ground truth"] if scored else []
        header, columns = ["method"], [[r["method"] for r in table["rows"]] + last]
        for scene, world in table["scenes"].items():
            cells = [r["scenes"][scene]["values"][m["id"]] for r in table["rows"]]
            truth = [METRICS[m["id"]].format(table["truth"][scene][m["id"]])] if scored else []
            header.append(world)
            columns.append(_marked([c["value"] for c in cells], m["id"], mark) + truth)
            if any(c["published"] is not None for c in cells):
                header.append("published")
                columns.append([METRICS[m["id"]].format(c["published"]) for c in cells] + ["-"] * len(last))
        blocks.append((m["title"], header, [list(row) for row in zip(*columns, strict=True)]))
    return blocks


def _marked(values: Sequence[float | None], metric: str, mark: Mark) -> list[str]:
    m = METRICS[metric]
    best = sorted({v for v in values if v is not None}, reverse=m.higher_is_better)[:2]
    return [mark(m.format(v), best.index(v)) if v is not None and v in best else m.format(v) for v in values]


def _reasons(table: Table) -> list[str]:
    """Return the reasons of missing values: one line for each metric and reason, with its cells."""
    found: dict[tuple[str, str], list[str]] = {}
    for row in table["rows"]:
        for scene, cell in row["scenes"].items():
            for metric, v in cell["values"].items():
                if v["value"] is None:
                    key = ("all metrics", v["reason"]) if cell["status"] != "ok" else (metric, v["reason"])
                    found.setdefault(key, []).append(f"{row['method']} on {scene}")
    lines = []
    for (metric, reason), cells in found.items():
        cells = list(dict.fromkeys(cells))
        where = "every cell" if len(cells) == len(table["rows"]) * len(table["scenes"]) else ", ".join(cells)
        lines.append(f"{metric}: {reason} ({where})")
    return lines


def _number(value: float | None, form: str) -> str:
    return "" if value is None else form.format(value)


def _pipes(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _ampersands(cells: Sequence[str]) -> str:
    return " & ".join(c.replace("_", r"\_").replace("%", r"\%") for c in cells) + r" \\"
