"""Enter result records into the leaderboard, each verified as far as its files allow."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.environment import environment, harness, utc_now
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.runs.apart.fit import Apart
from spike4dgs.benchmark.runs.record import Record, read_record
from spike4dgs.benchmark.scene.scene import Scene, open_scenes
from spike4dgs.leaderboard.entry import (
    CLAIMED,
    RE_FITTED,
    RE_SCORED,
    check_folder,
    check_no_oracle,
    check_numbers,
    entry_path,
    lock,
    remove_parts,
    write_entry,
)
from spike4dgs.leaderboard.rank import FILES, standing, write_boards
from spike4dgs.leaderboard.refit import fit_again, refits_of
from spike4dgs.leaderboard.thumbnails import Thumbnails, make_thumbnails
from spike4dgs.leaderboard.tracks import LOCAL, place_of, with_equivalents
from spike4dgs.leaderboard.truth_check import SecondRenderings, no_renderings
from spike4dgs.leaderboard.verify import verify_record


@dataclass(frozen=True)
class Files:
    """The files that a record is verified from, and how far."""

    predictions: Path | None
    scenes: tuple[Path, ...]
    allow_gaps: bool = False
    second_renderings: SecondRenderings = no_renderings
    refit: bool = False
    container: str = ""  # the command that starts the process of a second fit; see `Apart`


@dataclass(frozen=True)
class Verified:
    """A record, what was verified of it, why nothing was (an empty text otherwise), and thumbnails if it was."""

    record: Record
    verification: Mapping[str, Any]
    missing: str
    thumbnails: Thumbnails | None = None


@dataclass(frozen=True)
class Submitted:
    """What came of records, in lines: where they stand, what the boards do not list, and why some were refused."""

    standings: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)


def submit(result: Path, files: Files, leaderboard: Path, replace: bool = False) -> Submitted:
    """Verify a record as far as its files are given, and enter it. Raises UserError where it is refused."""
    check_folder(leaderboard)
    return _enter([_verify(result, files, leaderboard)], leaderboard, replace, None)


def submit_all(
    results: Mapping[Path, Path | None],
    *,
    scenes: tuple[Path, ...],
    leaderboard: Path,
    replace: bool = False,
    allow_gaps: bool = False,
) -> Submitted:
    """Enter several records, each with its predictions if there are some, and make the boards once.

    A record that is refused does not stop the others.
    """
    check_folder(leaderboard)
    verified, refused = [], list[str]()
    for result, predictions in results.items():
        try:
            verified.append(_verify(result, Files(predictions, scenes, allow_gaps), leaderboard))
        except UserError as e:
            refused.append(str(e))
    return _enter(verified, leaderboard, replace, refused)


def _verify(result: Path, files: Files, leaderboard: Path) -> Verified:
    record = read_record(result)
    check_no_oracle(record, result)
    check_numbers(record, result)
    entry_path(record)  # names that cannot be file names are refused before the work
    opened = open_scenes(files.scenes, files.allow_gaps, record["dataset"]["split"]) if files.scenes else []
    record = with_equivalents(record, opened)
    missing = _reason_not_to_verify(record, files.predictions, opened)
    if files.refit and missing:
        raise problem("--refit", "predictions and scenes of a scored record", missing, "give them")
    computed = {metric for cell in record["scenes"].values() for metric in cell["computed"]}
    if files.predictions is None or missing:
        nothing: dict[str, Any] = {"by": None, "truth": {}, "refit": None}
        unverified = [m for m in METRICS if m in computed]
        return Verified(record, {"label": CLAIMED, "unverified": unverified, **nothing}, missing)
    rescored = verify_record(record, result, files.predictions, opened, files.second_renderings)
    refit = None
    if files.refit:
        refit = fit_again(record, opened, refits_of(leaderboard), make_console(), Apart(files.container))
    verification = {
        "label": RE_FITTED if refit else RE_SCORED,
        "unverified": [m for m in METRICS if m in rescored.unverified],
        "by": {"when": utc_now(), "harness": harness(), "environment": environment("cpu")},
        "truth": {scene: asdict(check) for scene, check in rescored.truth.items()},
        "refit": asdict(refit) if refit else None,
    }
    return Verified(record, verification, "", make_thumbnails(record, files.predictions, opened))


def _enter(verified: Sequence[Verified], leaderboard: Path, replace: bool, refused: list[str] | None) -> Submitted:
    """Write entries and boards under the leaderboard's lock. Without `refused` the first refusal raises UserError."""
    entered = []
    with lock(leaderboard):
        remove_parts(leaderboard)
        for one in verified:
            try:
                entry = write_entry(leaderboard, one.record, one.verification, replace, one.thumbnails)
                entered.append((one, entry))
            except UserError as e:
                if refused is None:
                    raise
                refused.append(str(e))
        boards = write_boards(leaderboard)
    found, ranked = Submitted(refused=refused or []), False
    for one, entry in entered:
        v = entry["verification"]
        why = f" ({one.missing})" if one.missing and v["label"] == CLAIMED else ""
        if v["label"] != CLAIMED and v["unverified"]:
            why = f" (as claimed, not computed again: {', '.join(v['unverified'])})"
        at = standing(boards, entry_path(one.record))
        ranked = ranked or at.startswith("place")
        found.standings.append(f"{one.record['method']['name']}: {v['label']}{why}, {at}")
    if ranked:  # an interval, which takes a comparison with all others
        command = f"spike4dgs leaderboard --leaderboard {shlex.quote(str(leaderboard))}"
        found.standings.append(f"ranks, with their intervals: {command}")
    places = [place_of(one.record) for one, _ in entered]
    for folder, reason in dict.fromkeys((p.folder, p.why) for p in places if not p.is_public):
        found.standings.append(f"local board, in {leaderboard / FILES[LOCAL]}, not on a track: {folder}: {reason}")
    for board in boards.values():
        found.warnings.extend(f"not listed: {leaderboard / i['entry']}: {i['reason']}" for i in board["refused"])
    return found


def _reason_not_to_verify(record: Record, predictions: Path | None, scenes: Sequence[Scene]) -> str:
    """Return the reason why the record cannot be verified, or an empty string."""
    if predictions is not None and not predictions.is_dir():
        raise problem(predictions, "a predictions folder", "no such folder", "check the path of --predictions")
    if predictions is None:
        return "no --predictions"
    if absent := sorted(set(record["scenes"]) - {s.id for s in scenes}):
        return f"no --scenes for {', '.join(absent)}"
    if all(cell["status"] != "ok" for cell in record["scenes"].values()):
        return "nothing was scored"
    return ""
