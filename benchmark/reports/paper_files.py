"""From a run's records to the files of one of the paper's tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from spike4dgs.benchmark.metrics.metric import Metric
from spike4dgs.benchmark.reports.paper_tables import PublishedTable, build_table, truth_scores
from spike4dgs.benchmark.reports.scatter import write_views
from spike4dgs.benchmark.reports.table_files import write_table
from spike4dgs.benchmark.runs.record import Record, dataset_means
from spike4dgs.benchmark.scene.scene import Scene

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
