"""The entries of a leaderboard, each checked once.

To check an entry takes some ms, and every submission reads them all. So what the checks found is kept in the user's
cache folder, by the SHA-256 of an entry's bytes and its path: an entry that did not change is not checked again, and
for the boards not even parsed, as the file keeps what they need of it. Whether the ledger has an entry is asked
always. All entries are checked anew where the code that checks them changed. The folder is the user's, and nothing of
it comes with a leaderboard, so that nobody else can say that an entry was checked.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from spike4dgs.benchmark import schemas
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import read_bytes, read_json, user_cache, write_bytes
from spike4dgs.benchmark.metrics.table import PRIMARY
from spike4dgs.benchmark.runs.record import with_later_metrics
from spike4dgs.benchmark.untrusted import printable
from spike4dgs.leaderboard import tracks
from spike4dgs.leaderboard.entry import KIND, Entry, parse_entry
from spike4dgs.leaderboard.ledger import FOLDERS, check_listed, entry_paths, read_ledger
from spike4dgs.leaderboard.thumbnails import KEY

FEWEST = 10  # entries of a leaderboard whose checks are kept: fewer are checked in less than a tenth of a second
_HEAVY = {  # what boards do not need
    "cell": ("computed", "notes", "error", "predictions_sha256"),
    "record": ("environment", "command", "created"),
}
Known = dict[str, list[Any]]  # digest of path and bytes -> (the ledger's hash, what the boards need)


@dataclass(frozen=True)
class Reading:
    """Entries by path, their hashes as in the ledger, and why others were refused: those do not block the board."""

    entries: dict[str, Entry] = field(default_factory=dict)
    hashes: dict[str, str] = field(default_factory=dict)
    refused: dict[str, str] = field(default_factory=dict)

    def of(self, folder: str) -> Reading:
        """Return what is in one of `FOLDERS`."""

        def inside(values: dict[str, Any]) -> dict[str, Any]:
            return {path: value for path, value in values.items() if path.startswith(f"{folder}/")}

        return Reading(inside(self.entries), inside(self.hashes), inside(self.refused))


def read_entries(leaderboard: Path, *folders: str) -> tuple[dict[str, Entry], dict[str, str]]:
    """Return the entries by path, and why others were refused, by path; every entry is checked."""
    found = read_all(leaderboard, *folders)
    return found.entries, found.refused


def read_all(leaderboard: Path, *folders: str) -> Reading:
    """Read entries of the given ones of `FOLDERS`, and check every one."""
    return _read(leaderboard, folders, {}, brief=False)[0]


def read_checked(leaderboard: Path) -> Reading:
    """Read all entries; those whose checks are known are not checked again."""
    return _read_known(leaderboard, brief=False)


def read_briefs(leaderboard: Path) -> Reading:
    """Read what the boards need of all entries: of scores by image those of the primary metric alone."""
    return _read_known(leaderboard, brief=True)


def _read_known(leaderboard: Path, brief: bool) -> Reading:
    known = _known(leaderboard)
    reading, found = _read(leaderboard, FOLDERS, known, brief)
    if len(found) >= FEWEST and found.keys() != known.keys():
        _keep(leaderboard, found)
    return reading


def _read(leaderboard: Path, folders: tuple[str, ...], known: Known, brief: bool) -> tuple[Reading, Known]:
    """Return the entries, or what boards need of them, and what is known of them now."""
    ledger, reading, found = read_ledger(leaderboard), Reading(), Known()
    for path in entry_paths(leaderboard, *folders):
        where = leaderboard / path
        try:
            data = read_bytes(where, KIND)
            digest = hashlib.sha256(path.encode(errors="surrogateescape") + b"\0" + data).hexdigest()
            if digest in known:
                sha256, facts = found[digest] = known[digest]
                entry = facts if brief else _without_checks(data)
            else:
                entry, sha256 = parse_entry(data, where, path)
                facts = _brief(entry)
                found[digest] = [sha256, facts]
                entry = facts if brief else entry
            check_listed(sha256, path, where, ledger)
            reading.entries[path], reading.hashes[path] = entry, sha256
        except UserError as e:
            reading.refused[path] = printable(str(e).removeprefix(f"{where}: "))
    return reading, found


def _without_checks(data: bytes) -> Entry:
    entry: Entry = json.loads(data)
    return {**entry, "record": with_later_metrics(entry["record"])}


def _brief(entry: Entry) -> Entry:
    """Return an entry without what boards do not need: a tenth of its size."""
    record = {key: value for key, value in entry["record"].items() if key not in _HEAVY["record"]}
    scenes = {
        scene: {
            **{key: value for key, value in cell.items() if key not in _HEAVY["cell"]},
            "metrics": {PRIMARY: cell["metrics"][PRIMARY]},
            "fitted_with": {**cell["fitted_with"], "environment": _machine(cell["fitted_with"]["environment"])},
            "per_image": {name: {PRIMARY: values[PRIMARY]} for name, values in cell["per_image"].items()},
        }
        for scene, cell in record["scenes"].items()
    }
    return {**{k: v for k, v in entry.items() if k != KEY}, "record": {**record, "scenes": scenes}}


def _machine(environment: Mapping[str, Any] | None) -> dict[str, Any] | None:
    return {key: environment.get(key) for key in ("cpu", "gpu")} if environment else None


def _file(leaderboard: Path) -> Path:
    name = hashlib.sha256(str(leaderboard.resolve()).encode(errors="surrogateescape")).hexdigest()[:32]
    return user_cache() / "leaderboards" / f"{name}.json"


def _known(leaderboard: Path) -> Known:
    """Return what is kept of a leaderboard's entries; nothing where the code changed, or the file is damaged."""
    try:
        kept = json.loads(_file(leaderboard).read_bytes())
        return dict(kept["entries"]) if kept["code"] == _code() else {}
    except (OSError, ValueError, LookupError, TypeError):
        return {}


def _keep(leaderboard: Path, known: Known) -> None:
    try:
        text = json.dumps({"code": _code(), "entries": known}, separators=(",", ":"))
        write_bytes(_file(leaderboard), text.encode())
    except (OSError, UserError):  # without a cache folder entries are checked each time
        return


def _code() -> str:
    """Return a hash of all that decides on an entry: the sources and schemas of two rooms, and the release."""
    return _code_of(tracks.FOLDER / f"{tracks.RELEASE}.json")


@cache
def _code_of(release: Path) -> str:
    digest = hashlib.sha256()
    for root in (Path(schemas.__file__).parent, Path(__file__).parent):
        for path in sorted([*root.rglob("*.py"), *root.rglob("*.schema.json")]):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0")
            digest.update(path.read_bytes())
    digest.update(release.read_bytes())
    return digest.hexdigest()


def typical_fit_seconds() -> dict[str, float]:
    """Return the mean seconds of a fit by method in the shipped entries. Their machines differ: ratios count."""
    times: dict[str, list[float]] = {}
    for path in entry_paths(tracks.SHIPPED, tracks.PUBLIC):
        record = read_json(tracks.SHIPPED / path, "an entry")["record"]
        known = [cell["fit_seconds"] for cell in record["scenes"].values() if cell["fit_seconds"] is not None]
        times.setdefault(record["method"]["name"], []).extend(known)
    return {method: sum(known) / len(known) for method, known in times.items() if known}
