"""What the pixels that fewer than two training cameras see do to the PSNR of the whole image, and to its seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence

from spike4dgs.studies.kit.timing import markdown
from spike4dgs.studies.results.blocks import NOTHING, measured_part, metric_text, of_group, provenance
from spike4dgs.studies.results.changes import legend_of, mark
from spike4dgs.studies.results.comparison import MeasuredRow, rows_of
from spike4dgs.studies.results.records import Record
from spike4dgs.studies.results.tables import conditions, realistic

METRICS = ("psnr", "psnr_covisible")


def covisible_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of two tables: rows on the track `small`, and what conditions of camera and light change."""
    own, under = of_group(realistic.GROUP, records), conditions.of_conditions(records)
    track = _track_lines([record for record in own if METRICS[1] in record["metrics"]])
    changes = _condition_lines(under)
    if not track:
        return [NOTHING]
    heads = ("row", "PSNR", "PSNR, co-visible", "between seeds", "between seeds, co-visible")
    legend = (
        "dB. Between seeds: the standard deviation of a scene's value, pooled over scenes. Of conditions: the change "
        f"of the means of {' and '.join(conditions.WORLDS)}; of fewer cameras, between two sets of co-visible pixels."
    )
    shown = [record for record in (*own, *under) if METRICS[1] in record["metrics"]]
    groups = realistic.GROUP, *conditions.EVERY
    legend = legend_of(legend, changes)
    return [*markdown(heads, [*track, *changes]), "", legend, "", provenance(shown, *groups)]


def _track_lines(own: Sequence[Record]) -> list[list[str]]:
    """Return a line for each row that is complete over the scenes of the first."""
    names, scenes = [row.name for row in realistic.GROUP.rows], measured_part(realistic.GROUP, own).scenes
    rows = [row for row in rows_of(names, scenes, own) if row.values(METRICS[1]) is not None]
    return [
        [f"`{row.name}`, {len(scenes)} scenes", *(metric_text(row.mean(m), 2) for m in METRICS), *_deviations(row)]
        for row in rows
    ]


def _deviations(row: MeasuredRow) -> list[str]:
    found = [row.variance(metric) for metric in METRICS]
    return [metric_text(None if variance is None else math.sqrt(variance), 2) for variance in found]


def _condition_lines(own: Sequence[Record]) -> list[list[str]]:
    """Return a line for each condition that a row was measured under, and without."""
    names, lines = [row.name for row in conditions.GROUP.rows], []
    for condition in conditions.CONDITIONS[1:]:
        pairs = (conditions.rows_under(names, c, own) for c in (condition, condition.absent))
        for row, without in zip(*pairs, strict=True):
            found = [(row.mean(metric), without.mean(metric)) for metric in METRICS]
            known = [with_it - absent for with_it, absent in found if with_it is not None and absent is not None]
            if len(known) == len(METRICS):
                texts = (f"{change:+.2f}{mark(row, without)}" for change in known)
                lines.append([f"`{row.name}`, {condition.name}", *texts, "", ""])
    return lines
