"""Rank the entries: the boards are made from the entries and the release alone.

    leaderboard.json   the boards of the release's tracks
    local.json         boards of other scenes, revisions or splits, with the reason
    archive.json       entries of earlier releases, without ranks

A row is a method: the mean over the seeds of those of its entries that may be ranked and have one configuration, which
is equal code, parameters and verification. Those are re-scored or re-fitted, complete, not refined, and without flags,
which follow from the entry and the release. Every other entry is a row of its own after them, without rank.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.method import DEFAULT_GIVEN
from spike4dgs.benchmark.metrics.measure import mean
from spike4dgs.benchmark.metrics.table import METRICS, PRIMARY
from spike4dgs.benchmark.runs.record import COSTS, Record, is_complete
from spike4dgs.benchmark.runs.refinement import is_refined
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.benchmark.untrusted import printable
from spike4dgs.leaderboard.entry import BOARD, CLAIMED, LABELS, Entry
from spike4dgs.leaderboard.reading import Reading, read_briefs
from spike4dgs.leaderboard.tracks import ARCHIVE, LOCAL, PUBLIC, current_release, dataset_revision, on_release, place_of
from spike4dgs.leaderboard.truth_check import truth_flags

SCHEMA = "spike4dgs-leaderboard/2"
FILES = {PUBLIC: BOARD, LOCAL: "local.json", ARCHIVE: "archive.json"}
# Another rendering of the view with r times the truth's samples is 10 lg(1 + 1/r) dB below the noise ceiling: 3 dB with
# as many, 4 with two thirds.
RENDERED_DB = 4.0
CEILING, RENDERED, TRAINED = (
    "above the noise ceiling",
    "as near to the truth as another rendering",
    "trained on test scenes",
)
REFINED = "refined scores: the method is ranked by those at the calibrated pose"
_BEFORE = "of an earlier release: these scenes' bytes are not those of the current one"


def write_boards(leaderboard: Path) -> dict[str, dict[str, Any]]:
    """Write the boards from the entries and return them by folder. Equal entries give equal bytes.

    A file without entries is removed, except leaderboard.json. The caller holds the leaderboard's lock.
    """
    boards = make_boards(read_briefs(leaderboard))
    for folder, name in FILES.items():
        if folder in boards:
            write_json(leaderboard / name, boards[folder])
        else:
            (leaderboard / name).unlink(missing_ok=True)
    return boards


def make_boards(reading: Reading) -> dict[str, dict[str, Any]]:
    """Return the content of the boards by folder: always that of the tracks, the others where they have entries."""
    schema = load_schema("spike4dgs.leaderboard", "leaderboard.schema.json")
    keys = ("id", "title", "definition", "higher_is_better", "implementation", "takes", "unit", "digits")
    found = {}
    for folder, name in FILES.items():
        entries, refused = reading.of(folder).entries, reading.of(folder).refused
        if folder != PUBLIC and not entries and not refused:
            continue
        board = {
            "schema": SCHEMA,
            "release": current_release().number,
            "primary": PRIMARY,
            "metrics": [{key: getattr(m, key) for key in keys} for m in METRICS.values()],
            "boards": list(_public(entries) if folder == PUBLIC else _others(entries, folder)),
            "refused": [{"entry": printable(path), "reason": reason} for path, reason in sorted(refused.items())],
        }
        check_schema(board, schema, name, "restore the entries")
        found[folder] = board
    return found


def _public(entries: Mapping[str, Entry]) -> Iterable[dict[str, Any]]:
    release, known = current_release(), Known()
    places = {path: place_of(entry["record"]).tracks for path, entry in entries.items()}
    for track in release.tracks:
        if of_track := {path: entry for path, entry in entries.items() if track.name in places[path]}:
            facts = {"track": track.name, "title": track.title, "withheld": sorted(track.withheld), "why": ""}
            yield _board(facts, of_track, known)


def _others(entries: Mapping[str, Entry], folder: str) -> Iterable[dict[str, Any]]:
    by_folder: dict[str, dict[str, Entry]] = {}
    for path, entry in entries.items():
        by_folder.setdefault(path.rpartition("/")[0], {})[path] = entry
    for name, of_board in sorted(by_folder.items()):
        why = _BEFORE if folder == ARCHIVE else place_of(next(iter(of_board.values()))["record"]).why
        title = name.partition("/")[2].partition("@")[0]
        nothing: dict[str, Any] = {"track": None, "title": title, "withheld": [], "why": why}
        yield _board(nothing, of_board, Known(), ranked=folder != ARCHIVE)


def _board(facts: Mapping[str, Any], entries: Mapping[str, Entry], known: Known, ranked: bool = True) -> dict[str, Any]:
    record = next(iter(entries.values()))["record"]
    return {
        **facts,
        "dataset": on_release(record["dataset"]),
        "revision": dataset_revision(on_release(record["dataset"])),
        "protocol": record["protocol"],
        "rows": rank_entries(entries, ranked, known),
    }


@dataclass(frozen=True)
class Known:
    """What is known of some entries, whose boards share it: a track's entries stand on most other tracks as well."""

    entries: dict[str, tuple[list[str], str | None]] = field(default_factory=dict)  # path -> flags, configuration
    rows: dict[tuple[str, ...], dict[str, Any]] = field(default_factory=dict)  # by their entries' paths

    def configuration(self, path: str, entry: Entry) -> str | None:
        """Return what the entries of one row have in common; None for an entry that may not be ranked."""
        if path not in self.entries:
            flags = flags_of(entry)
            counts = is_verified(entry) and not flags
            self.entries[path] = flags, (_configuration(entry) or path) if counts else None
        return self.entries[path][1]

    def row(self, paths: Sequence[str], entries: Mapping[str, Entry]) -> dict[str, Any]:
        """Return the row of the entries at some paths."""
        if (key := tuple(paths)) not in self.rows:
            self.rows[key] = _row([entries[path] for path in paths], paths, self.entries[paths[0]][0])
        return self.rows[key]


def rank_entries(entries: Mapping[str, Entry], ranked: bool = True, known: Known | None = None) -> list[dict[str, Any]]:
    """Return the rows of one board, best first; of equal values the one submitted first comes first.

    `entries` are by path. Without `ranked` no row has a rank. `known` is of the same entries' other boards.
    """
    known = known or Known()
    groups: dict[tuple[bool, str], list[str]] = {}
    for path, entry in sorted(entries.items()):
        found = known.configuration(path, entry)
        configuration = found if ranked else None
        groups.setdefault((configuration is not None, configuration or path), []).append(path)
    rows = [(counts, known.row(paths, entries)) for (counts, _), paths in groups.items()]
    sign = -1.0 if METRICS[PRIMARY].higher_is_better else 1.0

    def order(row: tuple[bool, dict[str, Any]]) -> tuple[bool, float, str, str]:
        value = row[1]["mean"][PRIMARY]
        return not row[0], math.inf if value is None else sign * value, row[1]["submitted"], row[1]["entries"][0]

    return [
        {"rank": position if counts else None, **row}
        for position, (counts, row) in enumerate(sorted(rows, key=order), start=1)
    ]


def is_verified(entry: Entry) -> bool:
    """Return whether an entry is re-scored or re-fitted, complete and not refined; without flags it may be ranked."""
    record = entry["record"]
    checked = entry["verification"]
    complete = is_complete(record) and record["mean"][PRIMARY] is not None and not is_refined(record["method"]["name"])
    return complete and checked["label"] != CLAIMED and PRIMARY not in checked["unverified"]


def flags_of(entry: Mapping[str, Any]) -> list[str]:
    """Return the flags of an entry, each with the scenes that it comes from; none for what may be ranked."""
    record, truth = entry["record"], entry["verification"]["truth"]
    release, found = current_release(), dict[str, list[str]]()
    revisions = on_release(record["dataset"])["scenes"]
    for scene, cell in sorted(record["scenes"].items()):
        for flag in truth_flags(truth[scene]) if scene in truth else ():
            found.setdefault(flag, []).append(scene)
        revision, psnr = revisions[scene], cell["metrics"]["psnr"]
        ceiling = release.ceiling_db(scene, revision) or truth.get(scene, {}).get("ceiling_db")
        if psnr is not None and ceiling is not None and psnr > ceiling - RENDERED_DB:
            flag = CEILING if psnr > ceiling else RENDERED
            found.setdefault(flag, []).append(f"{scene} has {psnr:.1f} of {ceiling:.1f} dB")
        if any(_names(text, name) for text in record["method"]["trained_on"] for name in (scene, revision)):
            found.setdefault(TRAINED, []).append(scene)
    return [f"{flag} ({', '.join(scenes)})" for flag, scenes in found.items()]


def _names(text: str, name: str) -> bool:
    """Return whether a text has a name as a word of its own: car-1-small does not name car-1-small-lens."""
    return _word(name).search(text) is not None


@lru_cache(1024)  # of a board there are some tens
def _word(name: str) -> re.Pattern[str]:
    return re.compile(rf"(?<![\w.-]){re.escape(name)}(?![\w.-]*\w)", re.IGNORECASE)


def _configuration(entry: Entry) -> str | None:
    """Return what the seeds of a method have in common: all of the method but the seed, budgets, code, verification.

    None where the code that fitted is not stated: such images may be of anything that bears the method's name.
    """
    record, checked = entry["record"], entry["verification"]
    method = {k: v for k, v in record["method"].items() if k != "seed"}
    cells = {scene: (cell["budget"], cell["fitted_with"]["harness"]) for scene, cell in record["scenes"].items()}
    if any(code is None for _, code in cells.values()):
        return None
    return json.dumps([method, cells, checked["label"], sorted(checked["unverified"])], sort_keys=True)


def _row(entries: Sequence[Entry], paths: Sequence[str], flags: list[str]) -> dict[str, Any]:
    """Return the row of one method's entries, which are several only if all may be ranked: then without flags."""
    records, checks = [e["record"] for e in entries], [e["verification"] for e in entries]
    first = records[0]
    return {
        "method": first["method"]["name"],
        "label": min((c["label"] for c in checks), key=LABELS.index),
        "flags": flags,
        "seeds": sorted({r["method"]["seed"] or 0 for r in records}),
        "entries": list(paths),
        "submitted": min(e["submitted"] for e in entries),
        "mean": {metric: mean(r["mean"][metric] for r in records) for metric in METRICS},
        "unverified": [m for m in METRICS if any(m in c["unverified"] for c in checks)],
        "status": {scene: cell["status"] for scene, cell in first["scenes"].items()},
        "given": first["method"].get("given", list(DEFAULT_GIVEN)),
        "trained_on": first["method"]["trained_on"],
        **({"equivalent": equivalent} if (equivalent := _equivalent(records)) else {}),
        "costs": {
            cost: {
                "claimed": mean(_of_scenes(cost, r["scenes"]) for r in records),
                "re-fitted": mean(_of_scenes(cost, c["refit"]["costs"] if c["refit"] else {}) for c in checks),
            }
            for cost in COSTS
        },
        "code": {
            "claimed": sorted({_code(r["harness"]) for r in records}),
            "verifier": sorted({_code(c["by"]["harness"]) for c in checks if c["by"]}),
        },
    }


def _equivalent(records: Sequence[Record]) -> dict[str, float]:
    """Return the share of spike bits by which the scenes of some records differ from the release's, by scene."""
    found = [(scene, of["bits"]) for r in records for scene, of in r["dataset"].get("equivalent", {}).items()]
    return {scene: max(bits for name, bits in found if name == scene) for scene, _ in found}


def _of_scenes(cost: str, cells: Mapping[str, Mapping[str, Any]]) -> float | None:
    """Return a cost over scenes: the sum of fit times, the mean of others; None where a scene has none."""
    value = mean(cell[cost] for cell in cells.values())
    return value if value is None or cost != "fit_seconds" else value * len(cells)


def _code(harness: Mapping[str, Any]) -> str:
    commit = harness["commit"][:9] if harness["commit"] else "no commit"
    return f"{harness['version']} {commit}{' with changes' if harness['dirty'] else ''}"


def standing(boards: Mapping[str, Mapping[str, Any]], path: str) -> str:
    """Return where the entry at `path` stands, such as "place 1 of 3 by mean PSNR on ideal (release 2, ...)"."""
    found, by = [], f"by mean {METRICS[PRIMARY].title}"
    for folder, file in boards.items():
        for board in file["boards"]:
            ranked = sum(row["rank"] is not None for row in board["rows"])
            for row in (r for r in board["rows"] if path in r["entries"]):
                place = f"place {row['rank']} of {ranked} {by}" if row["rank"] else f"not ranked ({reason(row)})"
                made = ", ".join(f"{scene} {bits:.3%}" for scene, bits in row.get("equivalent", {}).items())
                other = f", on equivalent scenes (bits that differ: {made})" if made else ""
                found.append(f"{place} on {board_name(board, folder, file['release'])}{other}")
    return "; ".join(found) or "not listed"


def reason(row: Mapping[str, Any]) -> str:
    """Return the reason why a row has no rank."""
    if row["flags"]:
        return "; ".join(row["flags"])
    if missing := [f"{scene} {status}" for scene, status in row["status"].items() if status != "ok"]:
        return ", ".join(missing)
    if row["label"] == CLAIMED:
        return "nothing was computed again"
    return REFINED if is_refined(row["method"]) else f"no {PRIMARY}"


def board_name(board: Mapping[str, Any], folder: str, release: str) -> str:
    """Return a board's name with its revision, for messages."""
    revision = f"revision {board['revision'][:12]}"
    if folder == PUBLIC:
        return f"{board['track']} (release {release}, {revision})"
    split = board["dataset"]["split"]
    return f"the {folder} board {board['title']} ({revision}, split {split})"
