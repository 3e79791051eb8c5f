"""The rows of the page: what the committed entries and a reader's own finished runs claim, board by board."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import problem, unknown
from spike4dgs.benchmark.reports.console import seeds_of_methods
from spike4dgs.benchmark.runs.record import Record, is_complete, read_record
from spike4dgs.benchmark.runs.refinement import is_refined
from spike4dgs.benchmark.runs.results import of_each_seed, record_paths
from spike4dgs.leaderboard.entry import Entry
from spike4dgs.leaderboard.rank import REFINED, make_boards, reason
from spike4dgs.leaderboard.reading import Reading, read_briefs, read_checked
from spike4dgs.leaderboard.thumbnails import KEY, sheet_path
from spike4dgs.leaderboard.tracks import (
    ARCHIVE,
    LOCAL,
    PUBLIC,
    SHIPPED,
    current_release,
    dataset_revision,
    on_release,
    place_of,
    short,
)

_NAMED = 4  # scenes that a board's title names
ENTERED = "leaderboard"  # of a run: where `run-benchmark` enters its records
NOT_STATED = "not stated"
OWN = "own run"  # the label of a reader's records, beside those of entries


@dataclass(frozen=True)
class Row:
    """A method on a board: the records of its seeds, and what is known of them.

    `why` is the reason where the row is not `ranked`. `predictions` has the folders of a run that holds the images of
    the first seed, by scene; `sheet` is where that of the first seed's entry lies.
    """

    name: str
    label: str
    ranked: bool
    why: str
    records: tuple[Record, ...]
    entries: Mapping[str, Entry] = field(default_factory=dict)  # by path
    hashes: Mapping[str, str] = field(default_factory=dict)  # of the entries' files, as in the ledger
    run: Path | None = None
    predictions: dict[str, Path] = field(default_factory=dict)
    sheet: Path | None = None

    @property
    def thumbnails(self) -> Mapping[str, Any]:
        """What the first seed's entry states of its sheet; empty where it states none."""
        stated: Mapping[str, Any] = next(iter(self.entries.values()), {}).get(KEY, {})
        return stated

    @property
    def first(self) -> Record:
        """The record of the first seed."""
        return self.records[0]

    @property
    def hardware(self) -> str:
        """The machines of the fits, such as "AMD EPYC, 2 cores"."""
        cells = [c for r in self.records for c in r["scenes"].values() if c["status"] == "ok"]
        machines = [c["fitted_with"]["environment"] or {} for c in cells]
        return distinct(str(m.get("gpu") or m.get("cpu") or NOT_STATED) for m in machines)

    @property
    def unverified(self) -> set[str]:
        """The metrics whose values are as claimed in an entry: they give no rank."""
        return {metric for e in self.entries.values() for metric in e["verification"]["unverified"]}

    @property
    def apart(self) -> str:
        """What kept its second fits to the training parts, such as "process"; empty where there were none."""
        refits = (e["verification"]["refit"] for e in self.entries.values())
        return " / ".join(sorted({refit["apart"] for refit in refits if refit and "apart" in refit}))


@dataclass(frozen=True)
class Board:
    """Rows on the same scenes, revisions and split. `folder` is the leaderboard's: entries, local or archive."""

    name: str
    title: str
    folder: str
    why: str
    withheld: tuple[str, ...]
    dataset: Mapping[str, Any]
    rows: list[Row]

    @property
    def scenes(self) -> list[str]:
        """The scenes' ids, sorted."""
        return sorted(self.dataset["scenes"])


def gather(
    leaderboard: Path, runs: Sequence[Path], published: bool = False, brief: bool = False
) -> tuple[list[Board], list[dict[str, str]]]:
    """Return the boards of a leaderboard's entries with the rows of finished runs, and the refused entries.

    With `published` the entries that the package ships stand among them. A run's record that equals an entry, image by
    image, lends its images to the entry's row. With `brief` entries have what the ranking by the primary metric needs.
    Raises UserError where a run has no records.
    """
    boards, refused = [], []
    reading = read_briefs(leaderboard) if brief else read_checked(leaderboard)
    for folder, file in make_boards(reading).items():
        refused += file["refused"]
        boards += [_board(leaderboard, folder, board, reading) for board in file["boards"]]
    if published and leaderboard.resolve() != SHIPPED.resolve():
        _add_published(boards, brief)
    for run in runs:
        entered = [r for board in boards for row in board.rows for r in row.records]
        entered += [entry["record"] for entry in read_checked(run / ENTERED).entries.values()]
        for of_method in seeds_of_methods([_as_entered(record, entered) for record in run_records(run)]):
            for records in _by_dataset(of_method):
                for board in _boards_of(boards, records[0]):
                    _add_run(board, run, records)
    for board in boards:
        board.rows[:] = _distinct(board.rows)
    order = (PUBLIC, LOCAL, ARCHIVE)
    return sorted(boards, key=lambda b: order.index(b.folder)), refused


def distinct(texts: Iterable[str]) -> str:
    """Return different texts as one, sorted."""
    return " / ".join(sorted(set(texts))) or NOT_STATED


def _distinct(rows: Sequence[Row]) -> Iterator[Row]:
    """Yield rows with a number after each further one of a name: the page finds rows by their names."""
    count = Counter[str]()
    for row in rows:
        count[row.name] += 1
        yield row if count[row.name] == 1 else replace(row, name=f"{row.name} ({count[row.name]})")


def _as_entered(record: Record, entered: Sequence[Record]) -> Record:
    """Return a run's record with the equivalent scenes that its entry names: a run does not compare its scenes."""
    for other in (r for r in entered if "equivalent" in r["dataset"]):
        without = {key: value for key, value in other["dataset"].items() if key != "equivalent"}
        if without == record["dataset"] and _images(other) == _images(record):
            return {**record, "dataset": other["dataset"]}
    return record


def _by_dataset(records: Sequence[Record]) -> list[list[Record]]:
    """Return records in groups of the same scenes and split: of a killed run some seeds have fewer scenes."""
    groups: dict[str, list[Record]] = {}
    for record in records:
        groups.setdefault(dataset_revision(on_release(record["dataset"])), []).append(record)
    return list(groups.values())


def run_records(run: Path) -> list[Record]:
    """Return the records of a finished run, each seed once. Raises UserError where there is none."""
    if not (paths := record_paths(run)):
        raise problem(run, "a folder of run-benchmark with results/*.json", "none", "check the path of --runs")
    return of_each_seed([read_record(path) for path in paths])


def _board(leaderboard: Path, folder: str, board: Mapping[str, Any], reading: Reading) -> Board:
    rows = []
    for row in board["rows"]:
        own = {path: reading.entries[path] for path in row["entries"]}
        why = "" if row["rank"] else "archived" if folder == ARCHIVE else reason(row)
        name = Path(row["entries"][0]).stem if len(own) == 1 else row["method"]
        records = tuple(e["record"] for e in own.values())
        hashes = {path: reading.hashes[path] for path in own}
        sheet = sheet_path(leaderboard / row["entries"][0])
        rows.append(Row(name, row["label"], row["rank"] is not None, why, records, own, hashes, sheet=sheet))
    name, title = (board["track"], board["title"]) if board["track"] else (board["title"], in_words(board["dataset"]))
    return Board(name, title, folder, board["why"], tuple(board["withheld"]), board["dataset"], rows)


def _add_published(boards: list[Board], brief: bool) -> None:
    """Add the rows of the shipped entries, except those that are there; another row of a name is marked."""
    for theirs in gather(SHIPPED, (), brief=brief)[0]:
        same = (theirs.folder, theirs.name, theirs.dataset)
        ours = next((b for b in boards if (b.folder, b.name, b.dataset) == same), None)
        if ours is None:
            boards.append(theirs)
            continue
        names, hashes = {row.name for row in ours.rows}, {h for row in ours.rows for h in row.hashes.values()}
        for row in (r for r in theirs.rows if not hashes.issuperset(r.hashes.values())):
            ours.rows.append(replace(row, name=f"{row.name} (published)") if row.name in names else row)


def _boards_of(boards: list[Board], record: Record) -> Iterator[Board]:
    """Yield the boards that a record belongs to; one that has no entries yet is added."""
    place, dataset = place_of(record), on_release(record["dataset"])
    names = place.tracks or (place.folder.partition("/")[2].partition("@")[0],)
    tracks = {t.name: t for t in current_release().tracks}
    for name in names:
        for board in boards:
            if board.dataset == dataset and board.folder != ARCHIVE and board.name == name:
                break
        else:
            track = tracks.get(name) if place.is_public else None
            title, withheld = (track.title, tuple(sorted(track.withheld))) if track else (in_words(dataset), ())
            board = Board(name, title, PUBLIC if track else LOCAL, place.why, withheld, dataset, [])
            boards.append(board)
        yield board


def _add_run(board: Board, run: Path, records: Sequence[Record]) -> None:
    first = records[0]
    images = {_images(record): record for record in records}
    if not any(images.keys() <= set(map(_images, row.records)) for row in board.rows):
        name = f"{run.name}/{first['method']['name']}"
        complete, refined = all(map(is_complete, records)), is_refined(first["method"]["name"])
        missing = ", ".join(f"{s} {c['status']}" for s, c in first["scenes"].items() if c["status"] != "ok")
        why = missing or (REFINED if refined else "")
        board.rows.append(Row(name, OWN, complete and not refined, why, tuple(records), run=run))
    for row in board.rows:
        if record := images.get(_images(row.first)):
            row.predictions.update(_folders(run, record))


def _images(record: Record) -> tuple[Any, ...]:
    """Return what tells a record's images: the hashes of its predictions, by scene."""
    method = record["method"]
    hashes = sorted((scene, cell["predictions_sha256"]) for scene, cell in record["scenes"].items())
    return method["name"], method["seed"], *hashes


def _folders(run: Path, record: Record) -> dict[str, Path]:
    """Return the predictions folders by scene, of the run or of one of its further seeds."""
    name, seed = record["method"]["name"], record["method"]["seed"]
    for root in (run / f"seed-{seed}", run):
        found = {s: root / "predictions" / name / s for s, c in record["scenes"].items() if c["status"] == "ok"}
        if all(folder.is_dir() for folder in found.values()):
            return found
    return {}


def find_board(boards: Sequence[Board], name: str) -> Board:
    """Return the first board of a name, or the one that `titles` calls so. Raises UserError where there is none."""
    known = titles(boards)
    for board, title in zip(boards, known, strict=True):
        if name in (board.name, title):
            return board
    if name in {track.name for track in current_release().tracks}:
        fix = f"choose one of {', '.join(known)}, or enter the first result with `spike4dgs submit`"
        raise problem("--track", "a track with entries", f"{name}, which has none yet", fix)
    raise unknown("--track", name, known)


def in_words(dataset: Mapping[str, Any]) -> str:
    """Return the scenes of a board that is no track's in words.

    >>> in_words({"scenes": dict.fromkeys(["turntable-0-small", "bird-0-small"])})
    'bird and turntable, small'
    >>> in_words({"scenes": {"car-2-small-lens": ""}})
    'car-2-small-lens'
    """
    ids = sorted(dataset["scenes"])
    parts = [scene.split("-") for scene in ids]
    worlds, plain = [part[0] for part in parts], {tuple(part[1:]) for part in parts}
    if len(plain) > 1 or any(len(part) != 3 or part[1] != "0" for part in parts):
        worlds, profile = ids, ""
    else:
        profile = f", {parts[0][2]}"
    if len(worlds) > _NAMED:
        worlds = [*worlds[:_NAMED], f"{len(worlds) - _NAMED} more"]
    return " and ".join([", ".join(worlds[:-1]), worlds[-1]] if len(worlds) > 1 else worlds) + profile


def titles(boards: Iterable[Board]) -> list[str]:
    """Return a distinct identifier for each board, for links: its name, with its revision where a name comes twice."""
    boards = list(boards)
    names = [b.name if b.folder != ARCHIVE else f"archive-{b.name}" for b in boards]
    return [
        name if names.count(name) == 1 else f"{name}@{short(dataset_revision(board.dataset))}"
        for name, board in zip(names, boards, strict=True)
    ]
