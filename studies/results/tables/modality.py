"""Spikes against frames against events: the rows of `report modality` on all nine worlds, as a table of records."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from spike4dgs.benchmark.method import get_method
from spike4dgs.studies.kit.timing import markdown
from spike4dgs.studies.modality.command import COLUMNS, MEAN, ROWS, Row, plot, value_text
from spike4dgs.studies.results.blocks import NOTHING, RANKS, behind_texts, both_text, of_group, provenance
from spike4dgs.studies.results.changes import change_text, legend_of
from spike4dgs.studies.results.comparison import MeasuredRow, Ranking, rank, rows_of
from spike4dgs.studies.results.plan import PLAN, Group, once
from spike4dgs.studies.results.records import Record
from spike4dgs.studies.sensors import sensors_of

GROUP = Group(
    "modality",
    "Spikes, frames and events",
    tuple(f"{scene.partition('-')[0]}-10-small-50ms" for group in PLAN for scene in group.scenes),
    once(ROWS),
)
NOISE = "-others"  # of an id: frames and events have noise, see `make-dataset --noisy-others`
NOISY = Group(
    "modality-noisy",
    "Frames and events with noise",
    (f"car-10-small-50ms{NOISE}",),
    once(row for row in ROWS if row.startswith(("rgb", "edi"))),
)
_SHOWN = ("bits_per_second", "psnr_dynamic", "psnr", "temporal_error")


def modality_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of the table: quality and bits per second of a camera, ranked where things move."""
    own = of_group(GROUP, records)
    ranking = _ranking(own)
    if not ranking.rows:
        return [NOTHING]
    lines = []
    for measured, ranks, behind in zip(ranking.rows, ranking.ranks, behind_texts(ranking), strict=True):
        row = _shown(measured)
        texts = [value_text(row.summary, column) for column in _SHOWN]
        lines.append([ranks, f"`{row.method}`", " and ".join(row.sensors), *texts[:2], behind, *texts[2:]])
    bits, moving, *others = (COLUMNS[column] for column in _SHOWN)
    heads = ("rank", "row", "sensors", bits, moving, "behind the first, dB", *others)
    legend = (
        f"Means of {len(GROUP.scenes)} scenes. {RANKS} Rows with the cameras' calibration stand among rows without."
    )
    return [*markdown(heads, lines), "", legend, "", provenance(own, GROUP)]


def noisy_block(records: Sequence[Record]) -> list[str]:
    """Return the lines of a table: PSNR of the rows of frames and events without their noise, and what it changes."""
    own = of_group(NOISY, records)
    names = [row.name for row in NOISY.rows]
    noisy = [row for row in rows_of(names, NOISY.scenes, own) if row.is_complete]
    if not noisy:
        return [NOTHING]
    scenes = [scene.removesuffix(NOISE) for scene in NOISY.scenes]
    before = rows_of([row.name for row in noisy], scenes, of_group(GROUP, records))
    lines = [[f"`{a.name}`", both_text(b), change_text(a, b)] for a, b in zip(noisy, before, strict=True)]
    legend = "PSNR of the whole image / where things move, dB, on car. The cells without noise are of the table above."
    heads = ("row", "without noise", "with it")
    return [*markdown(heads, lines), "", legend_of(legend, lines), "", provenance(own, NOISY)]


def plot_modality(path: Path, records: Sequence[Record]) -> None:
    """Plot PSNR where things move against bits per second of a camera, of the rows that have all scenes."""
    plot(path, [_shown(row) for row in _ranking(of_group(GROUP, records)).rows])


def _ranking(own: Sequence[Record]) -> Ranking:
    return rank([row for row in rows_of(ROWS, GROUP.scenes, own) if row.is_complete])


def _shown(row: MeasuredRow) -> Row:
    costs = ("bits_per_second", "fit_seconds")
    values = {column: row.mean_cost(column) if column in costs else row.mean(column) for column in COLUMNS}
    return Row(row.name, sensors_of(get_method(row.name)), {MEAN: values}, {})
