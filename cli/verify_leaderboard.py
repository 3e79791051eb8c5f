"""`verify-leaderboard`: check a leaderboard's release, entries and boards."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.runs.apart.fit import Apart
from spike4dgs.benchmark.runs.record import Record
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.cli.submit import second_renderings_of
from spike4dgs.leaderboard.refit import fit_again, refits_of
from spike4dgs.leaderboard.tracks import current_release
from spike4dgs.leaderboard.verify_entries import verify_leaderboard as check

_NEEDS = {  # what an option does nothing without
    "--predictions": ("--scenes",),
    "--scenes": ("--predictions",),
    "--refit": ("--predictions", "--scenes"),
    "--container": ("--refit",),
}


def verify_leaderboard(
    leaderboard: Positional[Path] = Path("leaderboard"),
    *,
    predictions: Path | None = None,
    scenes: tuple[Path, ...] = (),
    allow_gaps: bool = False,
    refit: bool = False,
    container: str = "",
) -> int:
    """Check that the release is the frozen one, entries and sheets are as submitted, and boards follow from them.

    With predictions and scenes, entries whose files are there are also scored again, and the verification that they
    state is compared with the result. If an entry's predictions are there but are not its own, a line says why they are
    passed over; another says which metrics could not be computed here. Second renderings of a target take half a minute
    per scene. With --refit, entries that are labelled re-fitted are fitted again. Problems are listed on stderr, and
    the exit code is then 1.

    Args:
        leaderboard: Leaderboard folder.
        predictions: Folder of a run's predictions, METHOD/SCENE.
        scenes: Scene folders.
        allow_gaps: Accept recordings with gaps.
        refit: Fit again the entries labelled re-fitted.
        container: Command that starts the process of such a fit, as in `submit`.
    """
    if predictions is not None and not predictions.is_dir():
        raise problem(predictions, "a folder of predictions, METHOD/SCENE", "no such folder", "correct --predictions")
    asked = {"--predictions": predictions, "--scenes": scenes, "--refit": refit, "--container": container}
    for option, needed in _NEEDS.items():
        if asked[option] and (lacks := [name for name in needed if not asked[name]]):
            raise problem(option, f"{' and '.join(needed)} beside it", f"no {', '.join(lacks)}", "give all of them")
    if not leaderboard.is_dir():
        fix = "run this in a checkout, or give the leaderboard's folder"
        raise problem(leaderboard, "a leaderboard", "no such folder", fix)
    release = current_release()

    def again(record: Record, opened: Sequence[Scene]) -> object:
        return fit_again(record, opened, refits_of(leaderboard), make_console(), Apart(container))

    found = check(leaderboard, predictions, scenes, allow_gaps, second_renderings_of, again if refit else None)
    for line in found.passed_over:
        print(f"passed over: {line}", file=sys.stderr)
    for line in found.not_computed:
        print(f"not checked: {line}", file=sys.stderr)
    for line in found.problems:
        print(f"error: {line}", file=sys.stderr)
    again_text = f", {found.scored} scored again" if predictions is not None else ""
    if found.not_fitted:
        again_text += f", {found.not_fitted} labelled re-fitted and not fitted again (--refit)"
    count = f"{len(found.problems) or 'no'} problem{'s' * (len(found.problems) != 1)}"
    print(f"{leaderboard}: release {release.number}, {found.entries} entries{again_text}, {count}")
    return 1 if found.problems else 0
