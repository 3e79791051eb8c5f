"""Score a predictions folder. Reads only files: the images, the scene's ground truth and masks; never a model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.image_pair import ImagePair, check_images
from spike4dgs.benchmark.metrics.measure import fit_gain, measure, scene_means, scene_notes
from spike4dgs.benchmark.metrics.selection import Selection, select_metrics
from spike4dgs.benchmark.results.predictions import SUMS, MethodInfo, Predictions, open_predictions
from spike4dgs.benchmark.results.record import Cell, Record, build_record, missing_cell
from spike4dgs.benchmark.scene.scene import Scene, Target


def score_scene(predictions: Predictions, scene: Scene, selection: Selection) -> Cell:
    """Score predictions against the ground truth of `scene` by the selected metrics: one cell of a result record.

    Raises UserError for damaged images on either side.
    """
    info = predictions.info
    gain = fit_gain((pair.truth_radiance, pair.predicted_radiance) for _, pair in _pairs(predictions, scene))
    measured = {t.name: measure(pair, gain, selection.metrics) for t, pair in _pairs(predictions, scene)}
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


def open_for(root: Path, scene: Scene) -> Predictions:
    """Open a predictions folder and check that it was made for this revision and split of this scene."""
    if not scene.targets:
        raise problem(scene.root, "a scene with targets", "none in targets.json", "score a scene that has ground truth")
    predictions = open_predictions(root, scene.targets)
    info = predictions.info
    for what, found, expected in (
        ("scene", info.scene, scene.id),
        ("scene revision", info.scene_revision, scene.revision),
        ("split", info.split or scene.meta["default_split"], scene.split),
    ):
        if found is not None and found != expected:
            fix = "run the method on this scene, or score with the scene it was run on"
            raise problem(root, f"predictions for {what} {expected[:24]}", found[:24], fix)
    return predictions


def _pairs(predictions: Predictions, scene: Scene) -> Iterator[tuple[Target, ImagePair]]:
    """Yield targets with their images, checked, each camera's in the order of time.

    Read anew each time, so that no clip is held in memory: a pair knows the one before it, and no more.
    """
    earlier: tuple[Target, ImagePair] | None = None
    for target in sorted(scene.targets, key=lambda t: (t.camera, t.tick)):
        truth, image, moving = scene.ground_truth(target), predictions.read(target), scene.moving(target)
        where = f"{predictions.root / target.name}.exr"
        check_images(truth, image, moving, where)
        pair = ImagePair(truth, image, moving, where)
        if earlier and earlier[0].camera == target.camera:
            since_ms = (scene.t_us(target.tick) - scene.t_us(earlier[0].tick)) / 1000
            yield target, replace(pair, earlier=earlier[1], since_ms=since_ms)
        else:
            yield target, pair
        earlier = target, pair


def prediction_folders(root: Path, scenes: Sequence[Scene]) -> dict[str, Path]:
    """Return each scene's predictions folder: `root` itself for a single scene, or a subfolder named by scene id."""
    if (root / SUMS).is_file() or len(scenes) == 1 and not (root / scenes[0].id).is_dir():
        if len(scenes) > 1:
            fix = "give the folder that holds one predictions folder per scene id"
            raise problem(root, f"predictions for {len(scenes)} scenes", "predictions for one", fix)
        return {scenes[0].id: root}
    return {s.id: root / s.id for s in scenes}


def score_predictions(root: Path | str, scenes: Sequence[Scene], selection: Selection | None = None) -> Record:
    """Score one method's predictions on several scenes and return the result record.

    `root` holds one predictions folder per scene id; for a single scene it may be that folder. Without `selection` all
    metrics that this machine can compute are computed. A scene without a folder counts as skipped. Raises UserError for
    bad predictions, and where the folders are of different methods.
    """
    root, selection = Path(root), selection or select_metrics()
    if not root.is_dir():
        raise problem(root, "a predictions folder", "no such folder", "check the path or run the method")
    if len({s.id for s in scenes}) < len(scenes):
        raise problem("scenes", "distinct scenes", ", ".join(s.id for s in scenes), "give each scene once")
    cells: dict[str, Cell] = {}
    methods: dict[str, MethodInfo] = {}
    for scene_id, folder in prediction_folders(root, scenes).items():
        scene = next(s for s in scenes if s.id == scene_id)
        if folder.is_dir():
            predictions = open_for(folder, scene)
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
