"""The records that earlier runs left in the same folder, and all records as one CSV file."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import write_text
from spike4dgs.benchmark.runs.dataframe import SCENE_COLUMNS, scene_rows
from spike4dgs.benchmark.runs.predictions import open_predictions
from spike4dgs.benchmark.runs.record import Record, read_record
from spike4dgs.benchmark.scene.scene import Scene


def earlier_records(folder: Path, records: Sequence[Record]) -> tuple[list[Record], list[str]]:
    """Return the records of other methods in a run's `folder` on the same scenes, revisions and split, oldest first.

    All seeds of a method come together. Also return what is left out, a file name and a reason each: other scenes, or
    no record that this version reads.
    """
    names, dataset = {r["method"]["name"] for r in records}, records[0]["dataset"]
    found, left_out = [], []
    for path in sorted([*folder.glob("results/*.json"), *folder.glob("seed-*/results/*.json")]):
        if path.stem in names:
            continue
        try:
            record = read_record(path)
        except UserError as e:
            left_out.append(str(e))
            continue
        if record["dataset"] == dataset:
            found.append(record)
        else:
            left_out.append(f"{path}: other scenes, revisions or split")
    first: dict[str, str] = {}
    for record in found:
        name, created = record["method"]["name"], str(record["created"])
        first[name] = min(created, first.get(name, created))

    def order(record: Record) -> tuple[str, str, int]:
        method = record["method"]
        return first[method["name"]], method["name"], method["seed"] or 0

    return sorted(found, key=order), left_out


def of_one_seed(records: Sequence[Record]) -> list[Record]:
    """Return the first record of each method, for images that show one."""
    return list({r["method"]["name"]: r for r in reversed(records)}.values())[::-1]


def is_shown(record: Record, scene: Scene, folder: Path) -> bool:
    """Return whether a sheet can show a record's cell: a missing one, or one whose predictions `folder` still holds."""
    cell = record["scenes"][scene.id]
    if cell["status"] != "ok":
        return True
    try:
        return open_predictions(folder, scene.targets).sha256 == str(cell["predictions_sha256"])
    except UserError:
        return False


def write_results(path: Path, records: Sequence[Record]) -> None:
    """Write a tidy CSV file: a row for each method, seed and scene, a column for each metric and cost."""
    out = io.StringIO()
    writer = csv.DictWriter(out, SCENE_COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(row for record in records for row in scene_rows(record))
    write_text(path, out.getvalue())
