"""The paper's table 1 beside the sweep's: the order of its rows, as its scenes are not available."""

from __future__ import annotations

from collections.abc import Sequence

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.paper_tables import published, ranks
from spike4dgs.studies.kit.timing import markdown
from spike4dgs.studies.results.blocks import NOTHING, of_group, provenance
from spike4dgs.studies.results.comparison import rows_of
from spike4dgs.studies.results.plan import TABLE1
from spike4dgs.studies.results.records import Record

_METRICS = {"psnr": 2, "ssim": 4}  # both in the paper and in records -> digits


def published_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of the comparison: the paper's rows that are measured on all scenes, best first."""
    from scipy.stats import kendalltau

    table, own = published(1), of_group(TABLE1, records)
    names = [name for name, values in table.rows.items() if values]
    rows = [row for row in rows_of(names, TABLE1.scenes, own) if row.is_complete]
    if not rows:
        return [NOTHING]
    columns, taus = [], []
    for metric, digits in _METRICS.items():
        ours, theirs = [row.mean(metric) for row in rows], [table.mean(row.name, metric) for row in rows]
        pairs = zip(ours, ranks(ours, METRICS[metric]), ranks(theirs, METRICS[metric]), strict=True)
        columns.append([[f"{value:.{digits}f}", f"{rank} / {printed}"] for value, rank, printed in pairs])
        if len(rows) > 1:
            taus.append(f"{METRICS[metric].title} {kendalltau(ours, theirs).statistic:.2f}")
    lines = [[f"`{row.name}`", *of_psnr, *of_ssim] for row, of_psnr, of_ssim in zip(rows, *columns, strict=True)]
    lines.sort(key=lambda line: int(line[2].split()[0]))
    heads = ("row", "PSNR", "rank / published", "SSIM", "rank / published")
    agreement = [f"Kendall's tau with the published order: {', '.join(taus)}.", ""] if taus else []
    measured = [r for r in own if r["row"] in {row.name for row in rows}]
    return [*markdown(heads, lines), "", *agreement, provenance(TABLE1, measured)]
