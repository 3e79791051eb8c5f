"""`verify-leaderboard`: check a release, all entries and the boards, and score entries again where the files are."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import read_json
from spike4dgs.benchmark.runs.predictions import SUMS
from spike4dgs.benchmark.scene.scene import Scene, open_scenes
from spike4dgs.leaderboard.entry import FOLDERS, Entry, check_folder, read_entries
from spike4dgs.leaderboard.rank import FILES, make_boards
from spike4dgs.leaderboard.tracks import current_release
from spike4dgs.leaderboard.verify import verify_record


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
    check_folder(leaderboard)
    release = current_release()
    entries, refused = read_entries(leaderboard, *FOLDERS)
    problems = [f"{leaderboard / path}: {reason}" for path, reason in refused.items()]
    problems += _stale_boards(leaderboard)
    scored = 0
    if predictions is not None:
        opened = {scene: open_scenes([scene], allow_gaps)[0] for scene in scenes}
        by_id = {scene.id: path for path, scene in opened.items()}
        for path, entry in entries.items():
            try:
                scored += _score_again(leaderboard / path, entry, predictions, by_id, allow_gaps)
            except UserError as e:
                problems.append(str(e))
    for line in problems:
        print(f"error: {line}", file=sys.stderr)
    again = f", {scored} scored again" if predictions is not None else ""
    found = f"{len(problems)} problems" if problems else "no problems"
    print(f"{leaderboard}: release {release.number}, {len(entries)} entries{again}, {found}")
    return 1 if problems else 0


def _stale_boards(leaderboard: Path) -> Iterator[str]:
    """Yield a line for each board file that does not follow from the entries."""
    boards = make_boards(leaderboard)
    for folder, name in FILES.items():
        path = leaderboard / name
        if folder not in boards:
            if path.exists():
                yield f"{path}: expected no such file, as there are no entries in {folder}/; remove it"
            continue
        try:
            found: Mapping[str, object] | None = read_json(path, "a board")
        except UserError as e:
            yield str(e)
            continue
        if found != boards[folder]:
            yield f"{path}: expected what the entries give, found other content; submit any record again"


def _score_again(where: Path, entry: Entry, predictions: Path, scenes: Mapping[str, Path], allow_gaps: bool) -> bool:
    """Score an entry's predictions again if its files are there; return whether they are."""
    record = entry["record"]
    folder = predictions / record["method"]["name"]
    ok = [scene for scene, cell in record["scenes"].items() if cell["status"] == "ok"]
    if not ok or any(not (folder / scene / SUMS).is_file() or scene not in scenes for scene in ok):
        return False
    opened: list[Scene] = open_scenes([scenes[scene] for scene in ok], allow_gaps, record["dataset"]["split"])
    verify_record(record, where, folder, opened)
    return True
