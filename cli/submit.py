"""`submit`: check a result record and enter it into the leaderboard."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.leaderboard import submit as work
from spike4dgs.leaderboard.submit import Files, Submitted
from spike4dgs.leaderboard.truth_check import Renderings


def submit(
    result: Positional[Path],
    *,
    predictions: Path | None = None,
    scenes: tuple[Path, ...] = (),
    leaderboard: Path = Path("leaderboard"),
    refit: bool = False,
    replace: bool = False,
    allow_gaps: bool = False,
    container: str = "",
) -> int:
    """Check a result record and enter it into the leaderboard.

    With predictions and scenes, every hash and score is computed again, and the entry is labelled re-scored. With
    --refit the method is also fitted again, by a process that is given only the training parts of the scenes, and the
    entry is labelled re-fitted. Both get a small sheet of images for the page. Any other entry is labelled claimed and
    gets no rank. A record of a track's scenes and revisions goes to that track's board, any other to a local one.
    Submitting a record twice changes nothing.

    Args:
        result: Result record, as written by score or run-benchmark.
        predictions: The method's predictions folder, or the folder that holds one per scene id.
        scenes: Scene folders of the record's dataset.
        leaderboard: Leaderboard folder.
        refit: Fit the method again, with the record's seed, budget and device, and compare the scores.
        replace: Replace another record of the same method and seed, unless that one is verified better.
        allow_gaps: Accept recordings with gaps.
        container: Command that starts the process of the second fit, such as one with bwrap or docker; {work} and
            {part} stand for the folders that the process needs.
    """
    if container and not refit:
        raise problem("--container", "--refit beside it", "none", "add --refit, or leave --container out")
    files = Files(predictions, scenes, allow_gaps, second_renderings_of, refit, container)
    return _tell(work.submit(result, files, leaderboard, replace))


def submit_all(results: Mapping[Path, Path | None], **options: Any) -> int:
    """Submit several records, as `leaderboard.submit.submit_all` does, and print what came of it.

    Return how many were refused.
    """
    return _tell(work.submit_all(results, **options))


def second_renderings_of(scene: Scene) -> Renderings | None:
    """Return second renderings of a target, as far as one of our worlds made the scene."""
    from spike4dgs.generators.truth import second_renderings  # Mitsuba, only where it renders

    return second_renderings(scene)


def _tell(found: Submitted) -> int:
    for line in found.refused:
        print(f"error: {line}", file=sys.stderr)
    for line in found.standings:
        print(line)
    for line in found.warnings:
        print(f"warning: {line}", file=sys.stderr)
    return len(found.refused)
