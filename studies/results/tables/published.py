"""The paper's tables beside the sweep's: the order of rows, as its scenes are not available."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from statistics import fmean

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.paper_tables import PublishedTable, published, ranks, tau_of
from spike4dgs.studies.kit.timing import markdown
from spike4dgs.studies.results.blocks import NINE, NOTHING, both_text, of_group, provenance
from spike4dgs.studies.results.changes import change_text, legend_of
from spike4dgs.studies.results.comparison import RANKED_BY, MeasuredRow, differences, rows_of
from spike4dgs.studies.results.plan import TABLE1, TABLE5, UNPOSED, Group, once
from spike4dgs.studies.results.records import Record

_METRICS = {"psnr": 2, "ssim": 4}  # both in the paper and in records -> digits
_IMAGES = ("tfi", "tfp", "spk2img")  # of the paper's two-stage rows
_MOTIONS = ("d3dgs", "stg", "4dgs")
_GIVEN = {"spike4dgs-uncalibrated": "spike4dgs"}  # a row that estimates poses -> the one that is given them


def published_block(group: Group, number: int, records: Sequence[Record]) -> list[str]:
    """Return the lines of a comparison: the table's rows that are measured on all scenes, best first.

    Ranks are among the rows that the paper has.
    """
    table, own = published(number), of_group(group, records)
    planned = _names(group)
    rows = rows_of([name for name in table.rows if name in planned], group.scenes, own)
    rows = [row for row in rows if row.is_complete]
    in_paper = [row for row in rows if table.rows[row.name]]
    if not in_paper:
        return [NOTHING]
    rows.sort(key=lambda row: -(row.mean("psnr") or 0.0))
    columns, agreement = [], []
    for metric, digits in _METRICS.items():
        column, tau = _compared(table, rows, metric, digits)
        columns.append(column)
        agreement += [tau] if tau else []
    moving = [f"{row.mean(RANKED_BY):.2f}" for row in rows]
    lines = [
        [f"`{row.name}`", text, *of_psnr, *of_ssim]
        for row, text, of_psnr, of_ssim in zip(rows, moving, *columns, strict=True)
    ]
    heads = ("row", "PSNR, moving", "PSNR", "published", "rank / published", "SSIM", "published", "rank / published")
    taus = [f"Kendall's tau with the published order: {', '.join(agreement)}.", ""] if agreement else []
    return [*markdown(heads, lines), "", *taus, _provenance(own, group, rows)]


def _compared(
    table: PublishedTable, rows: Sequence[MeasuredRow], metric: str, digits: int
) -> tuple[list[list[str]], str]:
    """Return for each row its mean, the published one, and both ranks; and Kendall's tau, if there are two rows."""
    ours, theirs = [row.mean(metric) for row in rows], [table.mean(row.name, metric) for row in rows]
    known = [mean if printed is not None else None for mean, printed in zip(ours, theirs, strict=True)]
    parts = zip(ours, theirs, ranks(known, METRICS[metric]), ranks(theirs, METRICS[metric]), strict=True)
    column = [
        [f"{mean:.{digits}f}", "", ""]
        if printed is None
        else [f"{mean:.{digits}f}", f"{printed:.{digits}f}", f"{rank} / {printed_rank}"]
        for mean, printed, rank, printed_rank in parts
    ]
    tau = tau_of(zip(known, theirs, strict=True))
    return column, "" if tau is None else f"{METRICS[metric].title} {tau:.2f}"


def given_row(name: str) -> str:
    """Return the row that is given the poses that another estimates."""
    return _GIVEN.get(name, name.replace("+colmap", ""))


def unposed_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of table 1 with estimated poses, each row beside the one that is given them."""
    own = of_group(UNPOSED, records)
    rows = [row for row in rows_of(_names(UNPOSED), UNPOSED.scenes, own) if row.is_complete]
    if not rows:
        return [NOTHING]
    partners = {row.name: given_row(row.name) for row in rows}
    beside = replace(TABLE1, rows=once(dict.fromkeys(partners.values())))  # the same seed
    others = of_group(beside, records)
    given = {row.name: row for row in rows_of(partners.values(), TABLE1.scenes, others)}
    rows.sort(key=lambda row: -(row.mean(RANKED_BY) or 0.0))
    lines = []
    for row in rows:
        partner = given[partners[row.name]]
        texts = both_text(row), f"{row.mean('ssim'):.4f}", f"`{partner.name}`", change_text(row, partner)
        lines.append([f"`{row.name}`", *texts])
    heads = ("row", "PSNR / moving", "SSIM", "given poses", "change of PSNR / moving, dB")
    legend = legend_of(f"Means of {len(UNPOSED.scenes)} scenes.", lines)
    return [*markdown(heads, lines), "", legend, "", provenance([*own, *others], UNPOSED, beside)]


def views_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of table 5: PSNR of the whole image and where things move, by the number of training views."""
    own = [of_group(group, records) for group in TABLE5]
    measured = [rows_of(_names(group), group.scenes, found) for group, found in zip(TABLE5, own, strict=True)]
    lines = [
        [f"`{rows[0].name}`", *(both_text(row) for row in rows)]
        for rows in zip(*measured, strict=True)
        if any(row.is_complete for row in rows)
    ]
    if not lines:
        return [NOTHING]
    heads = ("training views", *(group.split.partition("-")[2] for group in TABLE5))
    every = [r for found in own for r in found]
    return [*markdown(heads, lines), "", provenance(every, *TABLE5)]


def pairs_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of two comparisons over the nine scenes: motions with equal images, images with equal motion."""
    own = of_group(NINE, records)
    names = [f"{images}+{motion}" for images in _IMAGES for motion in _MOTIONS]
    rows = {row.name: row for row in rows_of(names, NINE.scenes, own) if row.is_complete}
    pairs = [(f"{images}+stg", f"{images}+{motion}") for images in _IMAGES for motion in ("4dgs", "d3dgs")]
    pairs += [(f"tfp+{motion}", f"tfi+{motion}") for motion in _MOTIONS]
    lines = [_pair(rows[a], rows[b]) for a, b in pairs if a in rows and b in rows]
    if not lines:
        return [NOTHING]
    heads = ("row", "against", "PSNR, dB", "scenes ahead", "where things move, dB", "scenes ahead")
    return [*markdown(heads, lines), "", _provenance(own, NINE, rows.values())]


def _pair(one: MeasuredRow, other: MeasuredRow) -> list[str]:
    """Return a line: by how much the first is ahead in the mean, and on how many scenes."""
    texts = []
    for each in (differences(one, other, metric) for metric in ("psnr", RANKED_BY)):
        texts += [f"{fmean(each):+.2f}", str(sum(x > 0 for x in each))]
    return [f"`{one.name}`", f"`{other.name}`", *texts]


def _provenance(own: Sequence[Record], group: Group, shown: Iterable[MeasuredRow]) -> str:
    """Return `provenance` of the rows that are shown alone."""
    names = {row.name for row in shown}
    rows = tuple(row for row in group.rows if row.name in names)
    return provenance([r for r in own if r["row"] in names], replace(group, rows=rows))


def _names(group: Group) -> list[str]:
    return [row.name for row in group.rows]
