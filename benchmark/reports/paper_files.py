"""From a run's records to tables for papers: of the run, and one of the paper's tables."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.files import write_json, write_text
from spike4dgs.benchmark.metrics.metric import Metric
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.console import blocks_of
from spike4dgs.benchmark.reports.paper_tables import PublishedTable, build_table, truth_scores
from spike4dgs.benchmark.reports.scatter import write_views
from spike4dgs.benchmark.runs.record import COSTS, Record, dataset_means
from spike4dgs.benchmark.runs.refinement import is_refined
from spike4dgs.benchmark.scene.scene import Scene

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
        lines += [f"## {title}", "", *_markdown_table(header, body), ""]
    if reasons := _reasons(table):
        lines += ["## Values that do not exist", "", *(f"- {r}" for r in reasons), ""]
    return "\n".join(lines)


def to_latex(table: Table) -> str:
    """Return LaTeX: the same blocks as `tabular`s for the package booktabs."""
    marks: Mark = lambda text, rank: (rf"\textbf{{{text}}}", rf"\underline{{{text}}}")[rank]  # noqa: E731
    lines = []
    for title, header, body in (_summary(table, marks), *_metric_blocks(table, marks)):
        lines += _latex_table(title, header, body)
    return "\n".join(lines)


def write_results_table(folder: Path, records: Sequence[Record]) -> None:
    """Write the columns that a terminal shows of a run as table.md and table.tex, the means first, the best in bold."""
    metrics, costs, blocks = blocks_of(records)
    header = ["method", *(m.title + (f", {m.unit}" if m.unit else "") for m in metrics), *(COSTS[c][0] for c in costs)]
    markdown, latex = ["# Results", ""], list[str]()
    for block in [*blocks[-1:], *blocks[:-1]]:
        rows = [[name, *(f"**{text}**" if best else text for text, best in values)] for name, values in block.rows]
        markdown += [f"## {block.title}", "", *_markdown_table(header, rows), ""]
        rows = [
            [name, *(rf"\textbf{{{text}}}" if best else text for text, best in values)] for name, values in block.rows
        ]
        latex += _latex_table(block.title, header, rows)
    write_text(folder / "table.md", "\n".join(markdown))
    write_text(folder / "table.tex", "\n".join(latex))


def _markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [_pipes(header), _pipes(["---"] * len(header)), *map(_pipes, rows)]


def _latex_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    begin = [f"% {title}", rf"\begin{{tabular}}{{l{'r' * (len(header) - 1)}}}", r"\toprule", _ampersands(header)]
    return [*begin, r"\midrule", *map(_ampersands, rows), r"\bottomrule", r"\end{tabular}", ""]


def _summary(table: Table, mark: Mark) -> tuple[str, list[str], list[list[str]]]:
    """Return the block of means over scenes: each metric, its published mean and both ranks, then the costs."""
    header, columns = ["method"], [[r["method"] for r in table["rows"]]]
    for m in table["metrics"]:
        cells = [r["mean"][m["id"]] for r in table["rows"]]
        header.append(m["title"])
        columns.append(_marked(table, [c["value"] for c in cells], m["id"], mark))
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
            columns.append(_marked(table, [c["value"] for c in cells], m["id"], mark) + truth)
            if any(c["published"] is not None for c in cells):
                header.append("published")
                columns.append([METRICS[m["id"]].format(c["published"]) for c in cells] + ["-"] * len(last))
        blocks.append((m["title"], header, [list(row) for row in zip(*columns, strict=True)]))
    return blocks


def _marked(table: Table, values: Sequence[float | None], metric: str, mark: Mark) -> list[str]:
    """Return the rows' values with marks of the best two; a row of refined held-out poses has no mark, as no rank."""
    m, ranked = METRICS[metric], [not is_refined(r["method"]) for r in table["rows"]]
    pairs = list(zip(values, ranked, strict=True))
    best = sorted({v for v, counts in pairs if counts and v is not None}, reverse=m.higher_is_better)[:2]
    return [
        mark(m.format(v), best.index(v)) if counts and v is not None and v in best else m.format(v)
        for v, counts in pairs
    ]


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


Run = tuple[Sequence[Scene], Sequence[Record]]  # scenes with one split, and the records of all methods on them


def write_paper_table(
    table: PublishedTable, runs: Sequence[Run], worlds: Mapping[str, str], metrics: Sequence[Metric], folder: Path
) -> None:
    """Write table.* to `folder`: a column for each world, or for each split where the table compares numbers of views.

    runs: one for each split; worlds: scene id -> world. A table of several splits is also plotted, as views.png.
    """
    if not table.splits:
        ((scenes, records),) = runs
        columns, truths = worlds, {s.id: truth_scores(s, metrics) for s in scenes}
    else:
        records = join_splits([records for _, records in runs])
        opened = {column_of(s.id, s.split): s for scenes, _ in runs for s in scenes}
        columns = {name: scene.split for name, scene in opened.items()}
        truths = {name: truth_scores(scene, metrics) for name, scene in opened.items()}
    content = build_table(table, records, columns, truths)
    write_table(folder, content)
    if len(runs) > 1:
        write_views(folder / "views.png", content)


def in_every_split(runs: Sequence[Run]) -> list[Run]:
    """Return the runs with the methods that all of them have, in the order of the first."""
    names = [{r["method"]["name"]: r for r in records} for _, records in runs]
    common = [name for name in names[0] if all(name in of_run for of_run in names)]
    return [(scenes, [of_run[name] for name in common]) for (scenes, _), of_run in zip(runs, names, strict=True)]


def join_splits(runs: Sequence[Sequence[Record]]) -> list[Record]:
    """Join the records of several splits into one record per method, whose scenes are named by `column_of`."""
    joined = []
    for records in zip(*runs, strict=True):
        cells = {column_of(s, r["dataset"]["split"]): cell for r in records for s, cell in r["scenes"].items()}
        dataset = records[0]["dataset"] | {"split": ", ".join(r["dataset"]["split"] for r in records)}
        joined.append(records[0] | {"dataset": dataset, "scenes": cells, "mean": dataset_means(cells)})
    return joined


def column_of(scene: str, split: str) -> str:
    """Return the name of a scene with a split."""
    return f"{scene}, {split}"
