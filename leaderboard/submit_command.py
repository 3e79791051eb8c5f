"""`submit`: check a result record, verify it from the files where they are given, and enter it into the leaderboard."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.results.record import Record, read_record
from spike4dgs.benchmark.scene.scene import Scene, open_scenes
from spike4dgs.leaderboard.entry import SELF_REPORTED, VERIFIED, Entry, write_entry
from spike4dgs.leaderboard.rank import standing, write_leaderboard
from spike4dgs.leaderboard.verify import verify_record


def submit(
    result: Positional[Path],
    *,
    predictions: Path | None = None,
    scenes: tuple[Path, ...] = (),
    leaderboard: Path = Path("leaderboard"),
    replace: bool = False,
    allow_gaps: bool = False,
) -> int:
    """Check a result record and enter it into the leaderboard.

    With predictions and scenes, every hash and every score is computed again and the entry is labelled verified;
    scores whose weights are not on this machine are listed as unverified. Without predictions and scenes the entry is
    labelled self-reported. Submitting a record twice changes nothing.

    Args:
        result: Result record, as written by score or run-benchmark.
        predictions: The method's predictions folder, or the folder of one per scene id.
        scenes: Scene folders of the record's dataset.
        leaderboard: Leaderboard folder.
        replace: Replace another record of the same method.
        allow_gaps: Accept recordings with gaps.
    """
    line, entry = _enter(result, predictions, scenes, leaderboard, replace, allow_gaps)
    print(f"{line}, {standing(write_leaderboard(leaderboard), entry['record'])}")
    return 0


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
    entered = []
    for result, predictions in results.items():
        try:
            entered.append(_enter(result, predictions, scenes, leaderboard, replace, allow_gaps))
        except UserError as e:
            print(f"error: {e}", file=sys.stderr)
    board = write_leaderboard(leaderboard)
    for line, entry in entered:
        print(f"{line}, {standing(board, entry['record'])}")
    return len(results) - len(entered)


def _enter(
    result: Path,
    predictions: Path | None,
    scenes: tuple[Path, ...],
    leaderboard: Path,
    replace: bool,
    allow_gaps: bool,
) -> tuple[str, Entry]:
    """Verify a record as far as its files are given and write its entry; return the start of the line that says so."""
    record = read_record(result)
    opened = open_scenes(scenes, allow_gaps, record["dataset"]["split"]) if scenes else []
    missing = _reason_not_to_verify(record, predictions, opened)
    unverified = {metric for cell in record["scenes"].values() for metric in cell["computed"]}
    if predictions is not None and not missing:
        unverified = verify_record(record, result, predictions, opened)
    label = SELF_REPORTED if missing else VERIFIED
    entry = write_entry(leaderboard, record, label, [m for m in METRICS if m in unverified], replace)
    why = f" ({missing})" if missing and entry["label"] == label else ""
    if entry["label"] == VERIFIED and entry["unverified"]:
        why = f" (as claimed, for lack of weights: {', '.join(entry['unverified'])})"
    return f"{record['method']['name']}: {entry['label']}{why}", {**entry, "record": record}


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
