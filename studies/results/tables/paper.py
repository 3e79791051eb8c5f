"""The size of the paper's scenes: quality and costs of rows on the track `paper`, next to what the paper states."""

from __future__ import annotations

from collections.abc import Sequence

from spike4dgs.generators.worlds import OURS
from spike4dgs.studies.kit.timing import markdown
from spike4dgs.studies.results.blocks import NOTHING, measured_part, metric_text, of_group, provenance
from spike4dgs.studies.results.changes import incomplete_lines
from spike4dgs.studies.results.comparison import RANKED_BY, MeasuredRow, rows_of
from spike4dgs.studies.results.plan import Group, track_scenes
from spike4dgs.studies.results.records import Record
from spike4dgs.studies.results.tables.conditions import GROUP as CONDITIONS

GROUP = Group("paper", "The size of the paper's scenes", track_scenes("paper", OURS), CONDITIONS.rows)
FIT_S, IMAGES_PER_S = 1200, 40  # that the paper states for its method, on an RTX 4090
_HEADS = ("row", "PSNR, moving", "PSNR", "SSIM", "FLIP", "fit, s", "of 20 min", "images/s", "of 40", "memory, GB")


def paper_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of a table of the rows that have all scenes of the track that were measured, best first."""
    own = of_group(GROUP, records)
    group = measured_part(GROUP, own)
    scenes = group.scenes
    measured = [row for row in rows_of([row.name for row in GROUP.rows], scenes, own) if row.cells or row.failed]
    complete = sorted((row for row in measured if row.is_complete), key=lambda row: -(row.mean(RANKED_BY) or 0.0))
    if not complete:
        return [NOTHING]
    what = f"Means of {len(scenes)} scenes: {', '.join(scenes)}" if len(scenes) > 1 else scenes[0]
    legend = (
        f"{what}. Two columns relate costs to what the paper states for its method on an RTX 4090: 20 minutes a fit "
        f"and {IMAGES_PER_S} images/s. Times in parentheses were measured while other programs ran."
    )
    shown = [record for record in own if record["scene"] in scenes]
    table = [*markdown(_HEADS, map(_line, complete)), "", *incomplete_lines(measured)]
    return [*table, legend, "", provenance(shown, group)]


def _line(row: MeasuredRow) -> list[str]:
    fit, rate, memory = (row.mean_cost(name) for name in ("fit_seconds", "render_fps", "peak_memory_mb"))
    costs = ((fit, 0), (fit and fit / FIT_S, 2), (rate, 0), (rate and rate / IMAGES_PER_S, 2))
    times = (metric_text(value, digits) for value, digits in costs)
    quality = ((RANKED_BY, 2), ("psnr", 2), ("ssim", 4), ("flip", 3))
    means = (metric_text(row.mean(metric), digits) for metric, digits in quality)
    in_quiet = (time if row.is_quiet or time == "-" else f"({time})" for time in times)
    return [f"`{row.name}`", *means, *in_quiet, metric_text(memory and memory / 1e3, 1)]
