"""The ceilings of scores: what the noise of a scene's truth leaves to a prediction that has no error at all.

A ceiling is measured once for each scene, from two more renderings of its middle target, and kept as a row's record.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.generators.truth import second_renderings
from spike4dgs.leaderboard.truth_check import noise_ceiling_db
from spike4dgs.studies.results.comparison import RANKED_BY, MeasuredRow, rows_of
from spike4dgs.studies.results.plan import CEILING, UNCALIBRATED
from spike4dgs.studies.results.records import COSTS, Record, short


def measure_ceiling(scene: Scene) -> Record:
    """Return the part of a record that a scene's truth tells: PSNR against what it would be without noise.

    For scenes that a world of this installation made; others are skipped.
    """
    part: Record = {"knowledge": UNCALIBRATED, "metrics": {}, **dict.fromkeys(COSTS)}
    if (found := second_renderings(scene, lambda targets: targets[len(targets) // 2])) is None:
        return {**part, "error": "skipped: no world of this installation made the scene"}
    target, *others = found
    truth, moving = scene.ground_truth(target), scene.moving(target)
    ceilings = {
        "psnr": noise_ceiling_db(truth, *others),
        RANKED_BY: noise_ceiling_db(truth[moving], *(image[moving] for image in others)) if moving.any() else None,
    }
    return {**part, "metrics": {k: short(v) for k, v in ceilings.items() if v is not None}, "error": None}


def ceiling_row(scenes: Sequence[str], records: Iterable[Record]) -> MeasuredRow:
    """Return the ceilings of scenes as a row."""
    return rows_of([CEILING], scenes, records)[0]
