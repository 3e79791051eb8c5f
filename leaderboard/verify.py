"""Verify a record: hash and score the predictions again, and compare every value with the record's.

Fit time, speed and memory cannot be computed again: they must equal those in prediction.json. Metrics whose weights
this machine lacks are not compared.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.selection import select_metrics
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.results.record import COSTS, Cell, Record, same_value
from spike4dgs.benchmark.results.score import open_for, prediction_folders, score_scene
from spike4dgs.benchmark.scene.scene import Scene

GAIN_TOLERANCE = 1e-6  # relative: between machines the last bits of a mean differ


def verify_record(record: Record, where: Path, predictions: Path, scenes: Sequence[Scene]) -> set[str]:
    """Hash and score the predictions of every scored scene again; return the metrics that could not be computed.

    Raises UserError where a scene, a hash, the method or a score differs from the record.
    """
    used = [s for s in scenes if s.id in record["scenes"]]
    for scene in used:
        revision = record["dataset"]["scenes"][scene.id]
        if scene.revision != revision:
            fix = "give the scene that was scored, or score again"
            raise problem(scene.root, f"scene revision {revision[:16]}...", f"{scene.revision[:16]}...", fix)
    folders = prediction_folders(predictions, used)
    available, unverified = select_metrics(), set[str]()
    for scene in used:
        cell = record["scenes"][scene.id]
        if cell["status"] != "ok":
            continue
        found = open_for(folders[scene.id], scene)
        if found.sha256 != cell["predictions_sha256"]:
            expected = f"predictions {cell['predictions_sha256'][:16]}..."
            raise problem(found.root, expected, f"{found.sha256[:16]}...", "give the predictions that were scored")
        if found.info.method.as_dict() != record["method"]:
            expected = f"predictions of {record['method']['name']} as in the record"
            raise problem(found.root, expected, f"{found.info.method}"[:200], "score the predictions again")
        computed = score_scene(found, scene, available.among(cell["computed"]))
        # The same weights, or none: another MetaIQA says nothing about a claim.
        shared = {m for m, sha256 in computed["computed"].items() if cell["computed"][m] == sha256}
        _check_same(cell, computed, shared, f"{where}, scene {scene.id}")
        unverified |= cell["computed"].keys() - shared
    return unverified


def _check_same(claimed: Cell, computed: Cell, metrics: Collection[str], where: str) -> None:
    """Raise UserError at the first value of `metrics`, gain or cost that differs from the computed one."""
    fix = "score the predictions again with this version"
    gain = (claimed["gain_aligned"], computed["gain_aligned"])
    if not same_value(*gain, GAIN_TOLERANCE * (gain[1] or 1)):
        raise problem(where, f"gain_aligned {gain[1]}", str(gain[0]), fix)
    if set(claimed["per_image"]) != set(computed["per_image"]):
        found = f"{len(claimed['per_image'])} images"
        raise problem(where, f"scores of the {len(computed['per_image'])} targets", found, fix)
    for name, values in computed["per_image"].items():
        for metric in metrics:
            value = values[metric]
            if not same_value(claimed["per_image"][name][metric], value, METRICS[metric].tolerance):
                found = str(claimed["per_image"][name][metric])
                raise problem(f"{where}, {name}", f"{metric} = {value} as computed from the files", found, fix)
    for key in (*COSTS, "budget", "device", "fitted_with"):
        if claimed[key] != computed[key]:
            raise problem(where, f"{key} {computed[key]} as in prediction.json", str(claimed[key]), fix)
