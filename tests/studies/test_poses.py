import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from toy_world import ToyWorld

from spike4dgs.benchmark.errors import UserError
from spike4dgs.cli import main
from spike4dgs.method.msdi.training_data import points_of
from spike4dgs.method.starts.msdi import Estimate, shrunk
from spike4dgs.method.starts.structure_from_motion import clip_means
from spike4dgs.studies.poses import estimators
from spike4dgs.studies.poses.estimators import measure_poses, poses

WORLD = ToyWorld(width=96, height=60, n_ticks=60, travel=0.0, seed=1)


def test_calibrated_poses_have_no_error() -> None:
    row = measure_poses(WORLD.training, clip_means(WORLD.training), "rig", 0, calibrated=True)
    assert row["registered"] == "8 of 8" and int(row["points"] or 0) > 500
    assert row["rotation_max_deg"] == pytest.approx(0, abs=1e-6) and row["translation_m"] == pytest.approx(0, abs=1e-8)
    assert row["focal_ratio"] == 1 and row["maa_30"] == 1


def test_failures_are_rows_with_reasons(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SPIKE4DGS_DUST3R", raising=False)
    row = measure_poses(WORLD.training, clip_means(WORLD.training), "dust3r", 0, calibrated=True)
    assert row["registered"] == "0 of 8" and row["rotation_deg"] is None
    assert "SPIKE4DGS_DUST3R not set" in str(row["error"])
    dark = 0 * clip_means(WORLD.training)
    row = measure_poses(WORLD.training, dark, "colmap", 0, calibrated=True)
    assert row["registered"] == "0 of 8" and row["error"] == "fewer than two views have poses"


def test_cameras_at_one_place_are_a_row_with_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    first = WORLD.training.cameras[0]
    alike = tuple(replace(first, id=camera.id) for camera in WORLD.training.cameras)
    found = SimpleNamespace(cameras=alike, points=np.zeros((0, 3)))
    monkeypatch.setitem(estimators.ESTIMATORS, "rig", lambda *_: found)
    row = measure_poses(WORLD.training, clip_means(WORLD.training), "rig", 0, calibrated=True)
    assert row["registered"] == "8 of 8" and row["rotation_deg"] is None and "different positions" in str(row["error"])


def test_command_prints_and_writes_the_table(small_scene: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "poses.json"
    arguments = ["poses", str(small_scene), "--initialization", "rig", "colmap", "--images", "tfp", "--out", str(out)]
    arguments += ["--seed", str(2**62)]  # COLMAP's are C ints
    assert main(arguments) == 1, "an estimator failed"
    rows = json.loads(out.read_text())["rows"]
    assert [r["initialization"] for r in rows] == ["rig", "colmap"] and rows[0]["rotation_deg"] < 1e-6
    assert rows[1]["registered"] == "0 of 3"  # a pattern without parallax that is another one in each view
    assert "3 of 3" in capsys.readouterr().out


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_perfect_network_finds_the_rig_again(calibrated: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    small = tuple(shrunk(c, 2) for c in WORLD.training.cameras)
    depth = np.array([WORLD.trace(c, 0.5)[1] for c in small], np.float32)
    relative = np.stack([c.w2c @ np.linalg.inv(small[0].w2c) for c in small])
    points = points_of(depth, np.stack([c.K for c in small]), relative).astype(np.float64) / 3.7
    perfect = Estimate(2, small, depth, points, np.full(depth.shape, 9.0))
    monkeypatch.setattr("spike4dgs.studies.poses.estimators.infer", lambda scene, calibrated: perfect)
    row = measure_poses(WORLD.training, depth, "msdi", 0, calibrated=calibrated)
    assert row["registered"] == "8 of 8" and float(row["rotation_max_deg"] or 9) < 0.1
    assert float(row["translation_m"] or 9) < 0.01 and row["focal_ratio"] == pytest.approx(1, abs=0.01)
    points[2] = np.random.default_rng(0).normal(size=points[2].shape)
    row = measure_poses(WORLD.training, depth, "msdi", 0, calibrated=calibrated)
    assert f"a pose for {small[2].id}, found none" in str(row["error"])


def test_arguments_of_no_use_are_refused_at_once(small_scene: Path) -> None:
    with pytest.raises(UserError, match="names among rig, colmap, dust3r, msdi, matching, matched, found sift"):
        poses((small_scene,), initialization=("sift",))
    with pytest.raises(UserError, match="one of clip, flat, tfp"):
        poses((small_scene,), images="photo")
    with pytest.raises(UserError, match="--out: expected the name of a file, found the folder"):
        poses((small_scene,), out=small_scene.parent)
    with pytest.raises(UserError, match="at least one scene folder, found none"):
        poses(())


def test_a_place_that_cannot_be_written_is_told_before_the_work(small_scene: Path, monkeypatch) -> None:
    monkeypatch.setattr("spike4dgs.studies.poses.estimators.measure_poses", None)
    with pytest.raises(UserError, match="/proc/nowhere: expected"):
        poses((small_scene,), out=Path("/proc/nowhere/poses.json"))
