"""The records of the sweep: FOLDER/ROW.json has the measured cells of a row, one a line, so that diffs can be read."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json, write_text
from spike4dgs.benchmark.runs.record import Cell as Scored
from spike4dgs.benchmark.schemas import check_schema, load_schema

Record = dict[str, Any]  # a cell of record.schema.json
Key = tuple[str, str, int, float | str, str]
FORMAT = "spike4dgs-cells/1"
METRICS = (
    "psnr",
    "ssim",
    "psnr_dynamic",
    "ssim_dynamic",
    "psnr_covisible",
    "flip",
    "lpips_alex",
    "lpips_vgg",
    "temporal_error",
)
COSTS = ("fit_seconds", "render_fps", "peak_memory_mb")
DIGITS = 12  # of hashes in records
FAILED = "failed"  # the beginning of an error; the other is "skipped", such as for weights that are not there
NOT_FINITE = f"{FAILED}: not finite"
_MOST_ERROR = 300  # characters


def key_of(record: Record) -> Key:
    """Return what tells a record from all others: row, scene, seed, budget, split."""
    return record["row"], record["scene"], record["seed"], record["budget"], record["split"]


def scores_of(cell: Scored) -> Record:
    """Return the part of a record that a scored cell tells: metrics, costs, and why there are none."""
    metrics = {name: value for name in METRICS if (value := cell["metrics"].get(name)) is not None}
    return {
        "metrics": {name: short(value) for name, value in metrics.items()},
        **{name: None if (value := cell[name]) is None else short(value) for name in COSTS},
        "error": None if cell["status"] == "ok" else f"{cell['status']}: {cell['error']}"[:_MOST_ERROR],
    }


def with_finite(part: Record) -> Record:
    """Return the part of a record that a measurement tells, without metrics and with an error where one is not finite.

    A record has no place for NaN and infinity.
    """
    odd = [name for name, value in part["metrics"].items() if not math.isfinite(value)]
    return {**part, "metrics": {}, "error": f"{NOT_FINITE}: {', '.join(odd)}"} if odd else part


def short(value: float) -> float:
    """Return a number with the digits that records have."""
    return float(f"{value:.6g}")


def read_records(folder: Path) -> dict[Key, Record]:
    """Return the records of a folder by their keys; none where there is no folder.

    Raises UserError for a file that does not follow the schema, that holds another row than its name says, one cell
    twice, or another revision of a scene than the records before it: rows of two revisions cannot be compared.
    """
    found: dict[Key, Record] = {}
    revisions: dict[str, str] = {}
    for path in sorted(folder.glob("*.json")):
        for record in _read(path):
            if record["row"] != path.stem:
                raise problem(path, f"records of {path.stem}", record["row"], "rename the file")
            if key_of(record) in found:
                where = f"{record['scene']}, seed {record['seed']}"
                raise problem(path, f"one record of {where}", "two", "remove one")
            known = revisions.setdefault(record["scene"], record["revision"])
            if known != record["revision"]:
                what = f"revision {known} of {record['scene']}, as in other records"
                raise problem(path, what, record["revision"], "move the records of one of the two elsewhere")
            found[key_of(record)] = record
    return found


def _read(path: Path) -> list[Record]:
    content = read_json(path, "records of a row")
    check_schema(content, load_schema("spike4dgs.studies.results", "record.schema.json"), path, "restore the file")
    cells: list[Record] = content["cells"]
    return cells


def write_row(folder: Path, row: str, records: Iterable[Record]) -> None:
    """Write the file of a row, whole. Raises UserError for a record that does not follow the schema."""
    cells = sorted((r for r in records if r["row"] == row), key=_order)
    path = folder / f"{row}.json"
    content = {"format": FORMAT, "cells": cells}
    check_schema(content, load_schema("spike4dgs.studies.results", "record.schema.json"), path, "report this")
    lines = ",\n".join(json.dumps(cell, separators=(",", ":"), allow_nan=False) for cell in cells)
    write_text(path, f'{{"format": "{FORMAT}", "cells": [\n{lines}\n]}}\n')


def _order(record: Record) -> tuple[str, ...]:
    return str(record["budget"]), record["split"], f"{record['seed']:9}", record["scene"]


def measured(records: Mapping[Key, Record]) -> list[Record]:
    """Return the records that have metrics."""
    return [record for record in records.values() if record["error"] is None]
