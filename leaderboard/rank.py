"""Rank the entries: leaderboard.json has the rows of each dataset, split and protocol, made from the entries alone."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.metrics.table import METRICS, PRIMARY
from spike4dgs.benchmark.results.record import Record, is_complete
from spike4dgs.benchmark.scene.splits import DEFAULT_SPLIT
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.leaderboard.entry import Entry, entry_name, read_entry

SCHEMA = "spike4dgs-leaderboard/1"


def write_leaderboard(folder: Path) -> dict[str, Any]:
    """Write leaderboard.json from the entries and return its content. Equal entries give equal bytes."""
    entries = [read_entry(p) for p in sorted((folder / "entries").glob("*/*.json"))]
    boards: dict[str, list[Entry]] = {}
    for entry in entries:
        contest = {"dataset": entry["record"]["dataset"], "protocol": entry["record"]["protocol"]}
        boards.setdefault(json.dumps(contest, sort_keys=True), []).append(entry)
    keys = ("id", "title", "definition", "higher_is_better", "implementation", "takes", "unit", "digits")
    board = {
        "schema": SCHEMA,
        "primary": PRIMARY,
        "metrics": [{key: getattr(m, key) for key in keys} for m in METRICS.values()],
        "boards": [{**json.loads(contest), "rows": rank_entries(boards[contest])} for contest in sorted(boards)],
    }
    path = folder / "leaderboard.json"
    check_schema(board, load_schema("spike4dgs.leaderboard", "leaderboard.schema.json"), path, "restore the entries")
    write_json(path, board)
    return board


def rank_entries(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Return the rows of one board, best first: complete records are ranked, the others follow without a rank.

    Of equal values the one submitted first comes first.
    """
    sign = -1.0 if METRICS[PRIMARY].higher_is_better else 1.0

    def order(entry: Entry) -> tuple[float, str, str]:
        value = entry["record"]["mean"][PRIMARY] if is_complete(entry["record"]) else None
        name = entry["record"]["method"]["name"]
        return (math.inf if value is None else sign * value, entry["submitted"], name)

    rows = []
    for position, entry in enumerate(sorted(entries, key=order), start=1):
        record = entry["record"]
        seconds = [cell["fit_seconds"] for cell in record["scenes"].values()]
        rows.append(
            {
                "rank": None if order(entry)[0] == math.inf else position,
                "method": record["method"]["name"],
                "label": entry["label"],
                "unverified": entry["unverified"],
                "submitted": entry["submitted"],
                "entry": f"entries/{entry_name(record)}.json",
                "mean": record["mean"],
                "status": {scene: cell["status"] for scene, cell in record["scenes"].items()},
                "fit_seconds": None if None in seconds else math.fsum(seconds),
            }
        )
    return rows


def standing(board: Mapping[str, Any], record: Record) -> str:
    """Return the rank of a record on its board in words, such as "rank 1 of 3 on car-0-small"."""
    dataset = record["dataset"]
    where = dataset["name"] + ("" if dataset["split"] == DEFAULT_SPLIT else f", split {dataset['split']}")
    for contest in board["boards"]:
        for row in contest["rows"]:
            if row["entry"] == f"entries/{entry_name(record)}.json":
                ranked = "not ranked" if row["rank"] is None else f"rank {row['rank']} of {len(contest['rows'])}"
                return f"{ranked} on {where}"
    return "not listed"
