"""An entry of the leaderboard: a result record with its label.

    LEADERBOARD/entries/DATASET/METHOD.json         one record per method, labelled verified or self-reported
    LEADERBOARD/entries/DATASET/METHOD@SPLIT.json   the same on another split than the default one

DATASET is the ids of the scenes, joined by "+".
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.environment import utc_now
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json, write_json
from spike4dgs.benchmark.results.record import Record, check_record, with_later_metrics
from spike4dgs.benchmark.scene.splits import DEFAULT_SPLIT
from spike4dgs.benchmark.schemas import check_schema, load_schema

SCHEMA = "spike4dgs-entry/1"
VERIFIED, SELF_REPORTED = "verified", "self-reported"
Entry = dict[str, Any]


def entry_name(record: Mapping[str, Any]) -> str:
    """Return the path of a record's entry below `entries/`, without suffix: dataset, method, and split if not default.

    >>> entry_name({"method": {"name": "tfp+4dgs"}, "dataset": {"name": "car-0-small", "split": "corner"}})
    'car-0-small/tfp+4dgs@corner'
    """
    name, split = str(record["method"]["name"]), record["dataset"]["split"]
    return f"{record['dataset']['name']}/{name if split == DEFAULT_SPLIT else f'{name}@{split}'}"


def read_entry(path: Path) -> Entry:
    """Read an entry. Raises UserError where it is damaged or invalid, or where its file name is not its record's."""
    entry = read_json(path, "a leaderboard entry")
    check_schema(entry, load_schema("spike4dgs.leaderboard", "entry.schema.json"), path, "submit the record again")
    entry = {**entry, "record": with_later_metrics(entry["record"])}
    check_record(entry["record"], path)
    found = f"{path.parent.name}/{path.stem}"
    if (name := entry_name(entry["record"])) != found:
        raise problem(path, f"the entry of {found}", name, "rename the file or its folder")
    return entry


def write_entry(leaderboard: Path, record: Record, label: str, unverified: list[str], replace: bool) -> Entry:
    """Write a record's entry, or keep the one that makes the same claim; return the entry in the leaderboard.

    An entry that makes the same claim takes over a better label and a shorter list of unverified scores. Raises
    UserError where the method has another record there, unless `replace`.
    """
    path = leaderboard / "entries" / f"{entry_name(record)}.json"
    checked = {"label": label, "unverified": unverified}
    entry: Entry = {"schema": SCHEMA, **checked, "submitted": utc_now(), "record": record}
    if path.is_file():
        old = read_entry(path)
        if _claim(old["record"]) == _claim(record):
            if _confidence(entry) <= _confidence(old):
                return old
            entry = {**old, **checked}
        elif not replace:
            fix = "pass --replace to put the new record in its place"
            raise problem(path, "no entry of this method, or the same record", "another record", fix)
    write_json(path, entry)
    return entry


def _confidence(entry: Entry) -> tuple[bool, int]:
    return entry["label"] == VERIFIED, -len(entry["unverified"])


def _claim(record: Mapping[str, Any]) -> str:
    """Return the claim of a record, without when and where it was scored: equal claims are the same record."""
    context = ("created", "command", "environment", "harness")
    return json.dumps({k: v for k, v in record.items() if k not in context}, sort_keys=True)
