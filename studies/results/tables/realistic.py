"""The realistic camera: rows on the track `small`, and what its camera changes on the scenes that `ideal` has too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from spike4dgs.benchmark.variants import PUBLIC_VARIANT
from spike4dgs.generators.worlds import OURS
from spike4dgs.studies.kit.timing import markdown
from spike4dgs.studies.results.blocks import NOTHING, both_text, measured_part, of_group, provenance, table_block
from spike4dgs.studies.results.changes import change_text, legend_of
from spike4dgs.studies.results.comparison import rows_of
from spike4dgs.studies.results.plan import Group, track_scenes
from spike4dgs.studies.results.records import Record
from spike4dgs.studies.results.tables.conditions import GROUP as CONDITIONS

GROUP = Group("small", "A realistic camera", track_scenes("small", OURS), CONDITIONS.rows)


def realistic_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of the rows' table, over the scenes of the track that were measured."""
    own = of_group(GROUP, records)
    group = measured_part(GROUP, own)
    return table_block(group, own) if group.scenes else [NOTHING]


def cameras_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of a table of complete rows: the same worlds by the ideal camera and by the realistic one."""
    names, own = [row.name for row in GROUP.rows], of_group(GROUP, records)
    there = measured_part(GROUP, own).scenes
    pairs = {
        realistic: ideal
        for world in OURS
        for ideal in track_scenes("ideal", [world])
        for realistic in track_scenes("small", [world])
        if realistic in there and realistic.startswith(f"{world}-{PUBLIC_VARIANT}-")
    }
    ideal = of_group(replace(GROUP, scenes=tuple(pairs.values())), records)
    rows = [
        (real, other)
        for real, other in zip(
            rows_of(names, tuple(pairs), own), rows_of(names, tuple(pairs.values()), ideal), strict=True
        )
        if real.is_complete and other.is_complete
    ]
    if not rows:
        return [NOTHING]
    lines = [[f"`{r.name}`", both_text(o), both_text(r), change_text(r, o)] for r, o in rows]
    heads = ("row", "ideal camera", "realistic camera", "change")
    legend = (
        f"Whole image / where things move, dB; means of the same {len(pairs)} worlds, variants {PUBLIC_VARIANT}. "
        "Blur leaves less detail to get wrong, so compare rows within a column."
    )
    complete = {r.name for r, _ in rows}
    shown_rows = tuple(row for row in GROUP.rows if row.name in complete)
    groups = [replace(GROUP, scenes=tuple(scenes), rows=shown_rows) for scenes in (pairs, pairs.values())]
    shown = [record for group in groups for record in of_group(group, records)]
    return [*markdown(heads, lines), "", legend_of(legend, lines), "", provenance(shown, *groups)]
