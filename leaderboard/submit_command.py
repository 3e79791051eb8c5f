"""`submit`: check a result record, verify it as far as its files allow, and enter it into the leaderboard."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from spike4dgs.benchmark.environment import environment, harness, utc_now
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.console import make_console
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
from spike4dgs.leaderboard.refit import fit_again
from spike4dgs.leaderboard.tracks import LOCAL, place_of
from spike4dgs.leaderboard.truth_check import SecondRenderings, no_renderings
from spike4dgs.leaderboard.verify import verify_record

WORK = ".refit"  # of second fits, below the leaderboard


@dataclass(frozen=True)
class Files:
    """The files that a record is verified from, and how far."""

    predictions: Path | None
    scenes: tuple[Path, ...]
    allow_gaps: bool
    second_renderings: SecondRenderings = no_renderings
    refit_in: Path | None = None  # the folder of the second fit; None: it is not fitted again


@dataclass(frozen=True)
class Verified:
    """A record, what was verified of it, and why nothing was (an empty text otherwise)."""

    record: Record
    verification: Mapping[str, Any]
    missing: str


def make_submit(second_renderings: SecondRenderings) -> Callable[..., int]:
    """Return the command `submit`, which calls this function of another room."""

    def submit(
        result: Positional[Path],
        *,
        predictions: Path | None = None,
        scenes: tuple[Path, ...] = (),
        leaderboard: Path = Path("leaderboard"),
        refit: bool = False,
        replace: bool = False,
        allow_gaps: bool = False,
    ) -> int:
        """Check a result record and enter it into the leaderboard.

        With predictions and scenes, every hash and every score is computed again and the entry is labelled re-scored;
        with --refit the method is fitted again too, and the entry is labelled re-fitted. Anything else is claimed and
        gets no rank. A record of a track's scenes and revisions is on that track's board, any other on a local one.
        Submitting a record twice changes nothing.

        Args:
            result: Result record, as written by score or run-benchmark.
            predictions: The method's predictions folder, or the folder of one per scene id.
            scenes: Scene folders of the record's dataset.
            leaderboard: Leaderboard folder.
            refit: Fit the method again, with the record's seed, budget and device, and compare the scores.
            replace: Replace another record of the same method and seed.
            allow_gaps: Accept recordings with gaps.
        """
        check_folder(leaderboard)
        files = Files(predictions, scenes, allow_gaps, second_renderings, leaderboard / WORK if refit else None)
        _enter([_verify(result, files)], leaderboard, replace)
        return 0

    return submit


def submit_all(
    results: Mapping[Path, Path | None],
    *,
    scenes: tuple[Path, ...],
    leaderboard: Path,
    replace: bool = False,
    allow_gaps: bool = False,
) -> int:
    """Submit several records, each with its predictions if there are some; print the ranks once all are entered.

    A record that the leaderboard refuses is an error on stderr and does not stop the others. Return how many were.
    """
    check_folder(leaderboard)
    verified, refused = [], 0
    for result, predictions in results.items():
        try:
            verified.append(_verify(result, Files(predictions, scenes, allow_gaps)))
        except UserError as e:
            print(f"error: {e}", file=sys.stderr)
            refused += 1
    return refused + _enter(verified, leaderboard, replace, go_on=True)


def _verify(result: Path, files: Files) -> Verified:
    """Read a record and verify it as far as its files are given."""
    record = read_record(result)
    check_no_oracle(record, result)
    check_numbers(record, result)
    entry_path(record)  # names that cannot be file names are refused before the work
    opened = open_scenes(files.scenes, files.allow_gaps, record["dataset"]["split"]) if files.scenes else []
    missing = _reason_not_to_verify(record, files.predictions, opened)
    if files.refit_in and missing:
        raise problem("--refit", "predictions and scenes of a scored record", missing, "give them")
    computed = {metric for cell in record["scenes"].values() for metric in cell["computed"]}
    if files.predictions is None or missing:
        nothing: dict[str, Any] = {"by": None, "truth": {}, "refit": None}
        unverified = [m for m in METRICS if m in computed]
        return Verified(record, {"label": CLAIMED, "unverified": unverified, **nothing}, missing)
    rescored = verify_record(record, result, files.predictions, opened, files.second_renderings)
    refit = fit_again(record, opened, files.refit_in, make_console()) if files.refit_in else None
    verification = {
        "label": RE_FITTED if refit else RE_SCORED,
        "unverified": [m for m in METRICS if m in rescored.unverified],
        "by": {"when": utc_now(), "harness": harness(), "environment": environment("cpu")},
        "truth": {scene: check.as_dict() for scene, check in rescored.truth.items()},
        "refit": refit.as_dict() if refit else None,
    }
    return Verified(record, verification, "")


def _enter(verified: Sequence[Verified], leaderboard: Path, replace: bool, go_on: bool = False) -> int:
    """Write entries and boards under the leaderboard's lock, and print where the records stand.

    Return how many were refused; without `go_on` the first raises its UserError.
    """
    entered, refused = [], 0
    with lock(leaderboard):
        remove_parts(leaderboard)
        for one in verified:
            try:
                entered.append((one, write_entry(leaderboard, one.record, one.verification, replace)))
            except UserError as e:
                if not go_on:
                    raise
                print(f"error: {e}", file=sys.stderr)
                refused += 1
        boards = write_boards(leaderboard)
    for one, entry in entered:
        v = entry["verification"]
        why = f" ({one.missing})" if one.missing and v["label"] == CLAIMED else ""
        if v["label"] != CLAIMED and v["unverified"]:
            why = f" (as claimed, for lack of weights: {', '.join(v['unverified'])})"
        at = standing(boards, entry_path(one.record))
        print(f"{one.record['method']['name']}: {v['label']}{why}, {at}")
    places = [place_of(one.record) for one, _ in entered]
    for folder, reason in dict.fromkeys((p.folder, p.why) for p in places if not p.is_public):
        print(f"local board, in {leaderboard / FILES[LOCAL]}, not on a track: {folder}: {reason}")
    for board in boards.values():
        for item in board["refused"]:
            print(f"warning: not listed: {leaderboard / item['entry']}: {item['reason']}", file=sys.stderr)
    return refused


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
