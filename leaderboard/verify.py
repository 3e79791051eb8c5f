"""Verify a record.

The predictions of a record are hashed and scored again, and every value is compared with the record's.

Fit time, speed and memory cannot be computed again: they must equal those in prediction.json. Metrics whose weights
or files are not here are not compared. The predictions are compared with the truth and its noise (`truth_check`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.measure import select_metrics
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.runs.held_out import has_truth
from spike4dgs.benchmark.runs.record import COSTS, Cell, Record, same_value, sensor_of
from spike4dgs.benchmark.runs.score import open_for, prediction_folders, score_scene
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.leaderboard.tracks import match_release
from spike4dgs.leaderboard.truth_check import SecondRenderings, TruthCheck, check_truth, no_renderings

GAIN_TOLERANCE = 1e-6  # relative: between machines the last bits of a mean differ
# Of an equivalent scene's scores on the release: dB, and of other metrics relative. On `tiny` scenes with 8 and with 16
# lanes, the scores of an image by six methods differed by 0.0074 dB and 0.0017 at most.
ELSEWHERE_DB, ELSEWHERE = 0.02, 5e-3
# Fits on two CPUs differ by their last bits, which a fit amplifies: by 0.24 dB in a scene's mean PSNR at most, between
# two CPUs and six methods on car and turntable.
TOLERANCE_DB = 0.3


@dataclass(frozen=True)
class Rescored:
    """What came of scoring again: the metrics that could not be computed, and by scene the check beside the truth."""

    unverified: frozenset[str]
    truth: Mapping[str, TruthCheck]


def verify_record(
    record: Record,
    where: Path,
    predictions: Path,
    scenes: Sequence[Scene],
    second_renderings: SecondRenderings = no_renderings,
    fitted: Mapping[str, str] | None = None,
) -> Rescored:
    """Hash and score the predictions of every scored scene again, and check them beside the truth.

    `fitted`: scene id -> revision of the training part that the method was given instead of the scene. Raises
    UserError where a scene, a hash, the method or a score differs from the record.
    """
    used = [s for s in scenes if s.id in record["scenes"]]
    for scene in used:
        _check_scene(scene, record["dataset"])
        sensor = sensor_of(scene.meta)
        if (claimed := record.get("sensors", {}).get(scene.id, sensor)) != sensor:
            raise problem(f"{where}, scene {scene.id}", f"sensor {sensor or 'not stated'}", claimed, "score again")
    folders = prediction_folders(predictions, used)
    available, unverified, truth = select_metrics(), set[str](), dict[str, TruthCheck]()
    for scene in used:
        cell = record["scenes"][scene.id]
        if cell["status"] != "ok":
            continue
        revision = record["dataset"]["scenes"][scene.id]
        elsewhere = scene.revision != revision  # made and scored on an equivalent scene
        found = open_for(folders[scene.id], scene, {scene.id: revision} if elsewhere else fitted)
        if found.sha256 != cell["predictions_sha256"]:
            expected = f"predictions {cell['predictions_sha256'][:16]}..."
            raise problem(found.root, expected, f"{found.sha256[:16]}...", "give the predictions that were scored")
        method, claimed = found.info.method.as_dict(), record["method"]
        if "given" not in method:  # older predictions do not have the key
            claimed = {k: v for k, v in claimed.items() if k != "given"}
        if method != claimed:
            expected = f"predictions of {record['method']['name']} as in the record"
            raise problem(found.root, expected, f"{found.info.method}"[:200], "score the predictions again")
        computed = score_scene(found, scene, available.among(cell["computed"]))
        # The same weights, or none: another MetaIQA says nothing about a claim.
        shared = {m for m, sha256 in computed["computed"].items() if cell["computed"][m] == sha256}
        _check_same(cell, computed, shared, f"{where}, scene {scene.id}", elsewhere)
        unverified |= cell["computed"].keys() - shared
        if has_truth(scene):
            truth[scene.id] = check_truth(found, scene, second_renderings)
    return Rescored(frozenset(unverified), truth)


def _check_scene(scene: Scene, dataset: Mapping[str, Any]) -> None:
    """Raise UserError unless a scene is the one of a record's dataset, or the release's that this is equivalent to."""
    revision, *equivalent = revisions_of(scene.id, dataset)
    if scene.revision not in (revision, *equivalent):
        fix = "give the scene that was scored, or score again"
        raise problem(scene.root, f"scene revision {revision[:16]}...", f"{scene.revision[:16]}...", fix)
    if equivalent and scene.revision == revision:
        match = match_release(scene)
        if match is None or not match.is_equivalent or match.revision != equivalent[0]:
            found = next(iter(match.reasons), match.revision[:16]) if match else "no fingerprint to compare with"
            expected = f"a scene that is equivalent to revision {equivalent[0][:16]}..."
            raise problem(scene.root, expected, found, "submit the record again, with its scenes")


def _check_same(claimed: Cell, computed: Cell, metrics: Collection[str], where: str, elsewhere: bool) -> None:
    """Raise UserError at the first value of `metrics`, gain or cost that differs from the computed one.

    `elsewhere`: the scores were computed on an equivalent scene.
    """
    fix = "score the predictions again with this version"
    gain = (claimed["gain_aligned"], computed["gain_aligned"])
    if not same_value(*gain, (ELSEWHERE if elsewhere else GAIN_TOLERANCE) * (gain[1] or 1)):
        raise problem(where, f"gain_aligned {gain[1]}", str(gain[0]), fix)
    if set(claimed["per_image"]) != set(computed["per_image"]):
        found = f"{len(claimed['per_image'])} images"
        raise problem(where, f"scores of the {len(computed['per_image'])} targets", found, fix)
    for name, values in computed["per_image"].items():
        for metric in metrics:
            value = values[metric]
            tolerance = METRICS[metric].tolerance
            if elsewhere:
                tolerance = ELSEWHERE_DB if METRICS[metric].unit == "dB" else ELSEWHERE * max(abs(value or 0), 1)
            if not same_value(claimed["per_image"][name][metric], value, tolerance):
                found = str(claimed["per_image"][name][metric])
                raise problem(f"{where}, {name}", f"{metric} = {value} as computed from the files", found, fix)
    for key in (*COSTS, "budget", "device", "fitted_with"):
        if claimed[key] != computed[key]:
            raise problem(where, f"{key} {computed[key]} as in prediction.json", str(claimed[key]), fix)


def revisions_of(scene: str, dataset: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the revision of a record's scene, and the release's that it is equivalent to."""
    equivalent = dataset.get("equivalent", {}).get(scene)
    return dataset["scenes"][scene], *([equivalent["revision"]] if equivalent else [])
