"""An entry of the leaderboard: a result record with what was verified of it.

    LEADERBOARD/entries/RELEASE-TRACK@REVISION/METHOD.json          of a track
    LEADERBOARD/entries/RELEASE-TRACK@REVISION/METHOD@seed-K.json   another seed than 0
    LEADERBOARD/local/SCENE+N@REVISION/METHOD.json                  of any other scenes, revisions or split
    LEADERBOARD/archive/SCENE+N@REVISION/METHOD.json                of an earlier release
    .../METHOD.webp                                                 a sheet of images beside it (`thumbnails`)

REVISION begins the hash of the scenes' revisions and the split (`tracks.dataset_revision`). Paths follow from the
record's scenes, revisions, split, method and seed alone. Hidden files are no entries: a killed process may leave some.

LEADERBOARD/LEDGER has a line for every entry that `submit` wrote (`ledger`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.environment import utc_now
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import (
    json_object,
    locked,
    read_bytes,
    sha256_json,
    write_bytes,
    write_json,
)
from spike4dgs.benchmark.runs.record import Record, check_agreement, check_method_name, with_later_metrics
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.leaderboard.ledger import (
    FOLDERS,
    LEDGER,
    Ledger,
    add_line,
    check_listed,
    entry_paths,
    mark_replaced,
    read_ledger,
    same_but_for_case,
)
from spike4dgs.leaderboard.thumbnails import KEY, SUFFIX, Thumbnails, has_sheet, read_sheet, sheet_path, sheets
from spike4dgs.leaderboard.tracks import ARCHIVE, SHIPPED, on_release, place_of, released_targets

SCHEMA = "spike4dgs-entry/2"
CLAIMED, RE_SCORED, RE_FITTED = LABELS = ("claimed", "re-scored", "re-fitted")  # from the weakest to the strongest
KIND = "a leaderboard entry"  # of files, in errors
BOARD = "leaderboard.json"
_NEXT = f".next{SUFFIX}"  # of a sheet that waits for its entry
WAIT_S = 600.0  # for other submissions; one takes a second under the lock
Entry = dict[str, Any]
_LARGEST = 1e15  # of any number: sums and squares of such numbers stay finite
_RESERVED = {"con", "prn", "aux", "nul", *(f"{port}{i}" for port in ("com", "lpt") for i in range(10))}  # on Windows


def check_folder(leaderboard: Path) -> None:
    """Raise UserError unless a folder is a leaderboard, or new, or empty; an empty path is the working folder."""
    # Listed once: another submitter may be making the leaderboard, and writes the ledger first.
    names = {path.name for path in leaderboard.iterdir()} if leaderboard.is_dir() else set()
    if names & {BOARD, LEDGER}:
        return
    empty = all(name.startswith(".") for name in names) and (leaderboard.is_dir() or not leaderboard.exists())
    if leaderboard == Path() or not empty:
        found = "the working folder" if leaderboard == Path() else "something else"
        raise problem("--leaderboard", f"a leaderboard or a new folder at {leaderboard}", found, "name another folder")


def reading_folder(leaderboard: Path | None) -> Path:
    """Return the leaderboard to show: the one that is named, or `leaderboard` here, or the one that the package ships.

    Raises UserError where the named one does not exist or has no entries.
    """
    if leaderboard is None:
        here = Path("leaderboard")
        return here if next(entry_paths(here, *FOLDERS), None) else SHIPPED
    if next(entry_paths(leaderboard, *FOLDERS), None) is None:
        found = "none" if leaderboard.is_dir() else "no such folder"
        fix = "`run-benchmark` writes one to OUT/leaderboard; without --leaderboard you see the published entries"
        raise problem(leaderboard, "a leaderboard with entries", found, fix)
    return leaderboard


def file_name(record: Mapping[str, Any]) -> str:
    """Return the name of a record's entry, without suffix: the method, and the seed where it is not 0.

    >>> file_name({"method": {"name": "tfp+4dgs", "seed": 3}})
    'tfp+4dgs@seed-3'
    """
    seed = record["method"]["seed"]
    return str(record["method"]["name"]) + (f"@seed-{seed}" if seed else "")


def entry_path(record: Mapping[str, Any], archived: bool = False) -> str:
    """Return the path of a record's entry below the leaderboard.

    Raises UserError for names that cannot be file names everywhere.
    """
    name, seed = record["method"]["name"], record["method"]["seed"]
    check_method_name(name)
    if name.partition(".")[0].casefold() in _RESERVED or name.endswith("."):
        raise problem("method", "a name that every system takes as a file's", repr(name), "rename the method")
    if seed is not None and not (type(seed) is int and 0 <= seed < 2**63):  # JSON's 1.0 would be one more entry
        raise problem("method", "a seed from 0 up, of 64 bits", str(seed)[:40], "choose another seed")
    folder = place_of(record).folder
    if archived:
        folder = f"{ARCHIVE}/{folder.partition('/')[2]}"
    return f"{folder}/{file_name(record)}.json"


def read_entry(leaderboard: Path, path: str, ledger: Ledger) -> Entry:
    """Read the entry at `path` below the leaderboard.

    Raises UserError where it is damaged or invalid, where it belongs to another path, and where the ledger has no line
    for it.
    """
    where = leaderboard / path
    entry, sha256 = parse_entry(read_bytes(where, KIND), where, path)
    check_listed(sha256, path, where, ledger)
    return entry


def parse_entry(data: bytes, where: Path, path: str) -> tuple[Entry, str]:
    """Return the entry at `path` from its file's bytes, and the SHA-256 of its canonical JSON, as for the ledger.

    Raises UserError where it is damaged or invalid, and where it belongs to another path.
    """
    entry = json_object(data, where, KIND)
    if entry.get("schema") != SCHEMA:
        raise problem(where, f"schema '{SCHEMA}'", repr(entry.get("schema"))[:80], "submit the record again")
    check_numbers(entry, where)
    sha256 = sha256_json(entry)
    check_schema(entry, load_schema("spike4dgs.leaderboard", "entry.schema.json"), where, "submit the record again")
    record = with_later_metrics(entry["record"])  # its form is a part of the entry's
    check_agreement(record, where)
    check_no_oracle(record, where)
    check_targets(record, where)
    entry = {**entry, "record": record}
    if (name := entry_path(entry["record"], path.startswith(ARCHIVE))) != path:
        raise problem(where, f"the entry of {path}", f"that of {name}", "restore the file, or submit its record again")
    return entry, sha256


def check_targets(record: Record, where: Path) -> None:
    """Raise UserError where the images of a scored scene are not the targets that the release has of it."""
    dataset = on_release(record["dataset"])
    for scene, cell in record["scenes"].items():
        targets = released_targets(scene, dataset["scenes"][scene], dataset["split"])
        if cell["status"] == "ok" and targets and (other := sorted(targets ^ cell["per_image"].keys())):
            found = f"others or none: {', '.join(other)}"[:200]
            expected = f"scores of the {len(targets)} targets of the release"
            raise problem(f"{where}, scene {scene}", expected, found, "score the predictions again")


def check_no_oracle(record: Record, where: str | Path) -> None:
    """Raise UserError for the record of an oracle: a method that was given the truth, or freed of its own limits."""
    if marked := record["method"].get("oracle"):
        fix = "submit the record of the method itself"
        raise problem(where, "a method that fits from spikes", f"an oracle ({', '.join(marked)})", fix)


def check_numbers(value: Any, where: Path) -> None:
    """Raise UserError unless all numbers of a JSON value are finite and moderate, so that no arithmetic overflows.

    Integers that are called seed are left out: nothing is computed with them, and `entry_path` bounds the method's.
    """
    waiting = [value]
    while waiting:
        item = waiting.pop()
        if isinstance(item, int | float):
            if not -_LARGEST <= item <= _LARGEST:  # NaN compares false
                found = f"an integer of {len(str(abs(item)))} digits" if isinstance(item, int) else str(item)
                raise problem(where, f"numbers within +-{_LARGEST:g}", found, "score the predictions again")
        elif isinstance(item, dict):
            waiting += (value for key, value in item.items() if key != "seed" or not isinstance(value, int))
        elif isinstance(item, list):
            waiting += item


def write_entry(
    leaderboard: Path,
    record: Record,
    verification: Mapping[str, Any],
    replace: bool,
    thumbnails: Thumbnails | None = None,
) -> Entry:
    """Write a record's entry, or keep the one that makes the same claim; return the entry in the leaderboard.

    An entry that makes the same claim takes over a better verification, and thumbnails if its own are missing; with
    `replace` others of both. Another record of the same method and seed needs `replace`, unless it is verified and the
    old one is only claimed. The caller holds the leaderboard's lock. Raises UserError where it is needed, where the old
    record is verified better, and where another method's name differs by case alone.
    """
    name = entry_path(record)
    path = leaderboard / name
    check_no_oracle(record, path)
    for other in same_but_for_case({name, *entry_paths(leaderboard, name.partition("/")[0])}).get(name, ()):
        fix = "rename the method: some file systems take the two for one"
        raise problem(path, "a name that differs by more than case", other, fix)
    entry: Entry = {"schema": SCHEMA, "submitted": utc_now(), "verification": dict(verification), "record": record}
    if path.exists():
        try:
            old = read_entry(leaderboard, name, read_ledger(leaderboard))
        except UserError:
            if not replace:
                raise
        else:
            if _claim(old["record"]) == _claim(record):
                now, before = _confidence(entry), _confidence(old)
                better = now > before or (replace and now == before and _found(entry) != _found(old))
                if has_sheet(path, old) and not replace:
                    thumbnails = None
                if not better and thumbnails is None:
                    return old
                entry = {**old, "verification": dict(verification)} if better else old
            elif _confidence(entry)[0] < _confidence(old)[0]:
                found = f"one that is {entry['verification']['label']}"
                fix = "submit it with its predictions and scenes, and with --refit where the old one has it"
                raise problem(path, f"a record verified as well as the {old['verification']['label']} one", found, fix)
            elif not (replace or old["verification"]["label"] == CLAIMED != entry["verification"]["label"]):
                fix = "pass --replace to put the new record in its place"
                raise problem(path, "no entry of this method, or the same record", "another record", fix)
    if thumbnails:
        entry = {**entry, KEY: thumbnails.stated}
    # A process that is killed in between leaves a line too many, or a sheet that waits for `remove_parts`: never an
    # entry without its line.
    sha256 = sha256_json(entry)
    add_line(leaderboard, sha256, name)
    if thumbnails:
        write_bytes(_waiting(path), thumbnails.sheet)
    write_json(path, entry)
    if thumbnails:
        _waiting(path).replace(sheet_path(path))
    elif KEY not in entry:
        sheet_path(path).unlink(missing_ok=True)
    mark_replaced(leaderboard, sha256, name)
    return entry


def _waiting(entry: Path) -> Path:
    """Return where the new sheet of an entry waits until the entry is there."""
    return entry.with_name(f".{entry.stem}{_NEXT}")


def lock(leaderboard: Path) -> Any:
    """Return the leaderboard's lock, a context manager that waits for other submissions."""
    return locked(leaderboard / ".lock", leaderboard, "a leaderboard that other submissions leave in time", WAIT_S)


def remove_parts(leaderboard: Path) -> None:
    """Remove what killed processes left half written, and sheets without their entry, which the ledger lists.

    A sheet whose entry was written before its process was killed comes to its place.

    The caller holds the leaderboard's lock.
    """
    for pattern in (".*.part*", *(f"{folder}/*/.*.part*" for folder in FOLDERS)):
        for part in leaderboard.glob(pattern):
            if part.is_symlink() or not part.is_dir():
                part.unlink(missing_ok=True)
    ledger = read_ledger(leaderboard)
    for waiting in [path for folder in FOLDERS for path in leaderboard.glob(f"{folder}/*/.*{_NEXT}")]:
        entry = waiting.with_name(f"{waiting.name[1:].removesuffix(_NEXT)}.json")
        try:
            stated = read_entry(leaderboard, entry.relative_to(leaderboard).as_posix(), ledger)
            read_sheet(waiting, stated[KEY])
            waiting.replace(sheet_path(entry))
        except (UserError, KeyError):
            if waiting.is_symlink() or not waiting.is_dir():
                waiting.unlink(missing_ok=True)
    listed = {leaderboard / path for _, path in ledger}
    for sheet in sheets(leaderboard, *FOLDERS):
        if (entry := sheet.with_suffix(".json")) in listed and not entry.is_file():
            sheet.unlink(missing_ok=True)


def _confidence(entry: Entry) -> tuple[int, int, int]:
    v = entry["verification"]
    measured = sum(t["noise_share"] is not None for t in v["truth"].values())
    return LABELS.index(v["label"]), -len(v["unverified"]), measured


def _found(entry: Entry) -> dict[str, Any]:
    return {key: value for key, value in entry["verification"].items() if key != "by"}


def _claim(record: Mapping[str, Any]) -> str:
    """Return the claim of a record, without when and where it was scored: equal claims are the same record."""
    context = ("created", "command", "environment", "harness")
    return json.dumps({k: v for k, v in record.items() if k not in context}, sort_keys=True)
