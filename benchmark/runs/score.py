"""Score a predictions folder. Reads only files: images, the scene's truth, masks, depth and held-out spikes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.arrays import Mask
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.covisible import covisible
from spike4dgs.benchmark.metrics.image_pair import Image, ImagePair, check_images
from spike4dgs.benchmark.metrics.measure import Selection, fit_gain, measure, scene_means, scene_notes, select_metrics
from spike4dgs.benchmark.runs.held_out import Cameras, has_truth, open_cameras, targets_of, view_of, without_truth
from spike4dgs.benchmark.runs.predictions import SUMS, MethodInfo, Predictions, open_predictions
from spike4dgs.benchmark.runs.record import Cell, Record, build_record, check_scenes, missing_cell
from spike4dgs.benchmark.scene.scene import Scene, Target

_KEPT = 16  # targets whose images stay in memory: spikes around one are compared with those near it


def score_scene(predictions: Predictions, scene: Scene, selection: Selection, with_truth: bool = True) -> Cell:
    """Score predictions by the selected metrics, against the scene's truth and the held-out cameras' own spikes.

    Return one cell of a result record. Where the scene has no truth, or without `with_truth`, only the metrics remain
    that need none. Raises UserError for damaged images on either side.
    """
    info, compare = predictions.info, with_truth and has_truth(scene)
    selection = selection if compare else without_truth(selection)
    cameras, selection = open_cameras(scene, targets_of(scene), selection)
    gain = None
    if compare:
        gain = fit_gain((p.truth_radiance, p.predicted_radiance) for _, p in _pairs(predictions, scene, {}, True))
    masks = covisible(scene) if compare else {}
    if masks is None:
        masks, selection = {}, selection.without(("psnr_covisible",), "the scene's depth cannot be read")
    measured = {
        t.name: measure(replace(pair, covisible=masks.get(t.camera)), gain, selection.metrics)
        for t, pair in _pairs(predictions, scene, cameras, compare)
    }
    per_image = {name: m.values for name, m in measured.items()}
    return {
        "status": "ok",
        "metrics": scene_means(per_image),
        "computed": dict(selection.weights),
        "notes": scene_notes(per_image, {name: m.refused for name, m in measured.items()}, selection),
        "per_image": per_image,
        "gain_aligned": gain,
        "predictions_sha256": predictions.sha256,
        "fit_seconds": info.fit_seconds,
        "render_fps": info.render_fps,
        "peak_memory_mb": info.peak_memory_mb,
        "model_mb": info.model_mb,
        "budget": info.budget,
        "device": info.device,
        "fitted_with": {"harness": info.harness, "environment": info.environment},
        "error": None,
    }


def open_for(root: Path, scene: Scene, fitted: Mapping[str, str] | None = None) -> Predictions:
    """Open a predictions folder and check that it was made for this revision and split of this scene.

    `fitted`: scene id -> revision of its training part, where methods were given that instead of the whole scene.
    """
    predictions = open_predictions(root, targets_of(scene))
    info = predictions.info
    for what, found, expected in (
        ("scene", info.scene, scene.id),
        ("scene revision", info.scene_revision, (fitted or {}).get(scene.id, scene.revision)),
        ("split", info.split or scene.meta["default_split"], scene.split),
    ):
        if found is not None and found != expected:
            fix = "run the method on this scene, or score with the scene it was run on"
            raise problem(root, f"predictions for {what} {expected[:24]}", found[:24], fix)
    return predictions


def _pairs(
    predictions: Predictions, scene: Scene, cameras: Cameras, compare: bool
) -> Iterator[tuple[Target, ImagePair]]:
    """Yield targets with their images, checked, each camera's in the order of time.

    They have the spikes of the `cameras` that are given, and without `compare` no truth. Images are read anew each
    time, so that no clip is held in memory: a pair knows the one before it, and spikes the images near them.
    """
    everything = sorted(targets_of(scene), key=lambda t: (t.camera, t.tick))
    read = lru_cache(_KEPT)(lambda target: _read(predictions, scene, target, compare))
    earlier: tuple[Target, ImagePair] | None = None
    for target in everything:
        truth, image, moving = read(target)
        pair = ImagePair(truth, image, moving, f"{predictions.root / target.name}.exr")
        if camera := cameras.get(target.camera):
            own = [t for t in everything if t.camera == target.camera]
            truths = (lambda t: read(t)[0]) if compare else None
            pair = replace(pair, spikes=view_of(camera, target, own, lambda t: read(t)[1], truths))
        if earlier and earlier[0].camera == target.camera:
            since_ms = (scene.t_us(target.tick) - scene.t_us(earlier[0].tick)) / 1000
            yield target, replace(pair, earlier=earlier[1], since_ms=since_ms)
        else:
            yield target, pair
        earlier = target, pair


def _read(predictions: Predictions, scene: Scene, target: Target, compare: bool) -> tuple[Image, Image, Mask]:
    """Read and check a target's truth, prediction and moving region; without `compare` the truth is NaN."""
    camera, where = scene.cameras[target.camera], f"{predictions.root / target.name}.exr"
    image = predictions.read(target, (camera.height, camera.width))
    if compare:
        truth, moving = scene.ground_truth(target), scene.moving(target)
        check_images(truth, image, moving, where)
        return truth, image, moving
    nothing = np.zeros((camera.height, camera.width), np.float32)
    check_images(nothing, image, nothing > 0, where)
    return nothing * np.nan, image, nothing > 0


def prediction_folders(root: Path, scenes: Sequence[Scene]) -> dict[str, Path]:
    """Return each scene's predictions folder: `root` itself for a single scene, or a subfolder named by scene id."""
    if (root / SUMS).is_file() or len(scenes) == 1 and not (root / scenes[0].id).is_dir():
        if len(scenes) > 1:
            fix = "give the folder that holds one predictions folder per scene id"
            raise problem(root, f"predictions for {len(scenes)} scenes", "predictions for one", fix)
        return {scenes[0].id: root}
    return {s.id: root / s.id for s in scenes}


def score_predictions(
    root: Path | str,
    scenes: Sequence[Scene],
    selection: Selection | None = None,
    fitted: Mapping[str, str] | None = None,
) -> Record:
    """Score one method's predictions on several scenes and return the result record.

    `root` holds one predictions folder per scene id; for a single scene it may be that folder. Without `selection` all
    metrics that this machine can compute are computed. A scene without a folder counts as skipped; `fitted` is as for
    `open_for`. Raises UserError for bad predictions, and where the folders are of different methods.
    """
    root, selection = Path(root), selection or select_metrics()
    if not root.is_dir():
        raise problem(root, "a predictions folder", "no such folder", "check the path or run the method")
    check_scenes(scenes)
    cells: dict[str, Cell] = {}
    methods: dict[str, MethodInfo] = {}
    for scene_id, folder in prediction_folders(root, scenes).items():
        scene = next(s for s in scenes if s.id == scene_id)
        if folder.is_dir():
            predictions = open_for(folder, scene, fitted)
            cells[scene_id] = score_scene(predictions, scene, selection)
            methods[scene_id] = predictions.info.method
        else:
            cells[scene_id] = missing_cell("skipped", f"no predictions folder {folder.name}")
    if not methods:
        names = ", ".join(s.id for s in scenes)
        raise problem(root, f"a predictions folder for {names}", "none", "check the paths of predictions and scenes")
    return build_record(_one_method(methods, root), scenes, cells, "cpu")


def _one_method(methods: dict[str, MethodInfo], root: Path) -> MethodInfo:
    first = next(iter(methods.values()))
    for scene, method in methods.items():
        if method != first:
            fix = "give all scenes the same method, version, parameters and seed"
            raise problem(root, f"one method ({first.name})", f"another or another setting for {scene}", fix)
    return first
