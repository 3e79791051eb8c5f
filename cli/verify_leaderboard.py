"""`verify-leaderboard`: check a leaderboard's release, entries and boards."""

from __future__ import annotations

import sys
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.leaderboard.tracks import current_release
from spike4dgs.leaderboard.verify import verify_leaderboard as check


def verify_leaderboard(
    leaderboard: Positional[Path] = Path("leaderboard"),
    *,
    predictions: Path | None = None,
    scenes: tuple[Path, ...] = (),
    allow_gaps: bool = False,
) -> int:
    """Check a leaderboard folder: the release is the frozen one, entries are as submitted, boards follow from them.

    With predictions and scenes, entries are scored again too, as far as their files are there. Problems are listed on
    stderr, and the exit code is 1.

    Args:
        leaderboard: Leaderboard folder.
        predictions: Folder of a run's predictions, METHOD/SCENE.
        scenes: Scene folders.
        allow_gaps: Accept recordings with gaps.
    """
    release = current_release()
    found = check(leaderboard, predictions, scenes, allow_gaps)
    for line in found.problems:
        print(f"error: {line}", file=sys.stderr)
    again = f", {found.scored} scored again" if predictions is not None else ""
    count = f"{len(found.problems)} problems" if found.problems else "no problems"
    print(f"{leaderboard}: release {release.number}, {found.entries} entries{again}, {count}")
    return 1 if found.problems else 0
