"""Scenes scored by their held-out camera's own spikes: made ones, recorded ones without truth, damaged ones."""

import copy
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from changes import edit_json
from small_scenes import HEIGHT, TICKS, WIDTH

from spike4dgs.benchmark import METRICS, Scene, Target, UserError, open_scene
from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.metrics.measure import select_metrics
from spike4dgs.benchmark.runs.held_out import SPIKE_METRICS, has_truth, targets_of
from spike4dgs.benchmark.runs.predictions import MethodInfo, PredictionInfo, PredictionWriter, write_predictions
from spike4dgs.benchmark.runs.record import Cell, check_record, read_record, with_later_metrics, write_record
from spike4dgs.benchmark.runs.score import open_for, score_predictions, score_scene
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.cli import main

CHOSEN = select_metrics(("psnr", *SPIKE_METRICS))


def predict(folder: Path, scene: Scene, targets: tuple[Target, ...], truth: Scene, noise: float = 0.0) -> Path:
    """Write predictions: the pattern of the small scenes at the targets' ticks, and noise."""
    rng, (y, x) = np.random.default_rng(5), np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    with PredictionWriter(folder) as writer:
        for t in targets:
            image = 0.45 + 0.3 * np.sin((x - 0.1 * t.tick - 2 * int(t.camera[-1])) / 4) * np.cos(y / 5)
            writer.add(t, (image + noise * rng.normal(size=image.shape)).astype(np.float32), t.tick * 50.0)
        writer.finish(PredictionInfo(MethodInfo("m"), truth.id))
    return folder


def bare_copy(scene: Path, folder: Path) -> Path:
    """The scene as a real array leaves it: no image, no mask, no target."""
    root = Path(shutil.copytree(scene, folder))
    for name in ("images", "masks"):
        shutil.rmtree(root / name)
    write_json(root / "targets.json", {"targets": []})
    write_manifest(root)
    return root


def cell_of(folder: Path, scene: Scene, with_truth: bool = True) -> Cell:
    return score_scene(open_for(folder, scene), scene, CHOSEN, with_truth)


def test_a_made_scene_has_scores_of_both_kinds(small_scene: Path, tmp_path: Path) -> None:
    scene = open_scene(small_scene)
    good, bad = (cell_of(predict(tmp_path / str(n), scene, scene.targets, scene, n), scene) for n in (0.0, 0.1))
    for metric in ("psnr", "spike_psnr_5", "spike_psnr_20", "spike_psnr_20_dynamic"):
        assert good["metrics"][metric] > bad["metrics"][metric]
    assert good["metrics"]["spike_deviance"] == pytest.approx(0, abs=1e-3)  # half floats are not quite the truth
    assert bad["metrics"]["spike_deviance"] > 1
    # A window of 80 ticks around tick 40 of 80 is the only one within the clip.
    assert [name for name, v in good["per_image"].items() if v["spike_psnr_80"] is not None] == ["cam_03/000040"]
    assert good["notes"]["spike_psnr_80"].startswith("mean over the 1 of 3 images around which the camera recorded")


def test_a_recording_is_scored_by_its_spikes_alone(small_scene: Path, tmp_path: Path) -> None:
    whole, scene = open_scene(small_scene), open_scene(bare_copy(small_scene, tmp_path / "bare"))
    assert has_truth(whole) and not has_truth(scene)
    targets = targets_of(scene)
    assert targets == tuple(Target("cam_03", tick) for tick in range(20, TICKS - 19, 20))
    good, bad = (predict(tmp_path / f"p{n}", scene, targets, scene, n) for n in (0.0, 0.1))
    record, worse = (score_predictions(folder, [scene], CHOSEN) for folder in (good, bad))
    write_record(tmp_path / "r.json", record)
    assert read_record(tmp_path / "r.json") == record
    cell = record["scenes"][scene.id]
    found = {m for m, v in cell["metrics"].items() if v is not None}
    assert found == {m for m in SPIKE_METRICS if not m.endswith("_dynamic")}
    assert cell["gain_aligned"] is None and "psnr" not in cell["computed"]
    assert cell["notes"]["psnr"] == "not computed: the scene has no ground truth"
    assert cell["notes"]["spike_deviance_dynamic"] == "no image has a moving region and its ticks recorded"
    assert record["mean"]["spike_psnr_20"] > worse["mean"]["spike_psnr_20"]
    assert 0 < record["mean"]["spike_deviance"] < worse["mean"]["spike_deviance"]
    assert main(["score", str(good), str(scene.root), "--out", str(tmp_path / "by_command.json")]) == 0
    by_command = read_record(tmp_path / "by_command.json")["scenes"][scene.id]["metrics"]
    assert {m: by_command[m] for m in SPIKE_METRICS} == {m: cell["metrics"][m] for m in SPIKE_METRICS}


def test_images_of_any_program_become_predictions_of_a_recording(small_scene: Path, tmp_path: Path) -> None:
    scene = open_scene(bare_copy(small_scene, tmp_path / "bare"))
    camera = scene.cameras["cam_03"]
    images = {t: np.full((camera.height, camera.width), 0.45, np.float32) for t in targets_of(scene)}
    record = score_predictions(write_predictions(tmp_path / "mine", scene, images, "mine"), [scene], CHOSEN)
    assert record["mean"]["spike_psnr_20"] > 5
    with pytest.raises(UserError, match=r"the scene's targets, found 3 missing: cam_03/000020, .*; give an image"):
        write_predictions(tmp_path / "none", scene, {}, "mine")


def test_truth_that_is_not_wanted_is_not_read(small_scene: Path, tmp_path: Path) -> None:
    scene = open_scene(small_scene)
    folder = predict(tmp_path / "p", scene, scene.targets, scene)
    with_files = cell_of(folder, scene, with_truth=False)
    for name in ("images", "masks"):
        shutil.rmtree(small_scene / name)
    assert cell_of(folder, open_scene(small_scene), with_truth=False) == with_files
    assert with_files["metrics"]["psnr"] is None and with_files["metrics"]["spike_deviance"] > 0


def test_gaps_of_the_held_out_camera_leave_images_out(small_scene: Path, tmp_path: Path) -> None:
    gap = {"camera": "cam_03", "first_tick": 44, "ticks": 2, "reason": "lost"}
    edit_json(small_scene / "scene.json", lambda meta: meta.update(gaps=[gap]))
    write_manifest(small_scene)
    scene = open_scene(small_scene, allow_gaps=True)
    per_image = cell_of(predict(tmp_path / "p", scene, scene.targets, scene), scene)["per_image"]
    known = {name: {m for m in SPIKE_METRICS if values[m] is not None} for name, values in per_image.items()}
    assert "spike_psnr_20" not in known["cam_03/000040"] and "spike_deviance" not in known["cam_03/000040"]
    assert "spike_psnr_5" in known["cam_03/000040"] and "spike_psnr_20" in known["cam_03/000020"]
    assert all(values["psnr"] is not None for values in per_image.values())


def test_a_stream_that_cannot_be_read_takes_only_the_scores_of_spikes_away(small_scene: Path, tmp_path: Path) -> None:
    scene = open_scene(small_scene)
    folder = predict(tmp_path / "p", scene, scene.targets, scene)
    before = cell_of(folder, scene)
    (small_scene / scene.meta["streams"]["cam_03"]).unlink()
    after = cell_of(folder, open_scene(small_scene))
    assert {after["metrics"][m] for m in SPIKE_METRICS} == {None}
    assert after["notes"]["spike_psnr_5"] == "not computed: the stream or the recordings of cam_03 cannot be read"
    others = METRICS.keys() - set(SPIKE_METRICS)
    assert {m: after["metrics"][m] for m in others} == {m: before["metrics"][m] for m in others}


def test_a_recording_without_a_held_out_camera_is_refused(small_scene: Path, tmp_path: Path) -> None:
    root = bare_copy(small_scene, tmp_path / "bare")
    meta = json.loads((root / "scene.json").read_text())
    for split in meta["splits"].values():
        split["train"], split["test"] = [*split["train"], *split["test"]], []
    write_json(root / "scene.json", meta)
    transforms = {n: json.loads((root / f"transforms_{n}.json").read_text()) for n in ("train", "test")}
    transforms["train"]["frames"] += transforms["test"]["frames"]
    write_json(root / "transforms_train.json", transforms["train"])
    write_json(root / "transforms_test.json", {**transforms["test"], "frames": []})
    write_manifest(root)
    with pytest.raises(UserError, match=r"expected a held-out camera, or targets in targets\.json, found neither"):
        targets_of(open_scene(root))


def test_records_from_before_these_metrics_are_read_as_they_were(small_scene: Path, tmp_path: Path) -> None:
    scene = open_scene(small_scene)
    record = score_predictions(predict(tmp_path / "p", scene, scene.targets, scene), [scene], CHOSEN)
    old = copy.deepcopy(record)
    cell = old["scenes"][scene.id]
    for values in (old["mean"], cell["metrics"], cell["notes"], cell["computed"], *cell["per_image"].values()):
        for metric in SPIKE_METRICS:
            values.pop(metric, None)
    (tmp_path / "old.json").write_text(json.dumps(old))
    found = read_record(tmp_path / "old.json")
    check_record(found, "old.json")
    assert found == with_later_metrics(found) and {found["mean"][m] for m in SPIKE_METRICS} == {None}
    assert found["scenes"][scene.id]["notes"]["spike_psnr_5"] == "not computed: the record is older than the metric"
    assert {m: v for m, v in found["mean"].items() if m in old["mean"]} == old["mean"]
    del cell["metrics"]["psnr"]
    (tmp_path / "old.json").write_text(json.dumps(old))
    with pytest.raises(UserError, match="unknown or missing: psnr"):
        read_record(tmp_path / "old.json")
