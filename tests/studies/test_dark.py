"""Poses and points in less and less light: their errors, what estimators see, and tables of a toy world."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_scenes import HEIGHT, WIDTH, write_small_scene
from toy_bursts import write_toy_shard
from toy_world import ToyWorld

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.pose_error import Sim3
from spike4dgs.benchmark.scene.images import write_geometry
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.training_bursts import open_folder
from spike4dgs.studies.poses import dark, points
from spike4dgs.studies.poses.dark import ESTIMATORS, dark_poses, errors_of, see

WORLD = ToyWorld(width=96, height=61, seed=1)
TRUE = tuple(c for c in WORLD.cameras if c is not WORLD.held_out)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hidden shard, and one to train on."""
    folder = tmp_path_factory.mktemp("shards")
    write_toy_shard(folder, 12, width=96, height=61, resting=2)
    write_toy_shard(folder, 13, resting=1)
    return folder


def turned(degrees: float) -> np.ndarray:
    a = np.radians(degrees)
    return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])


def test_pairs_are_compared_in_any_frame_and_order() -> None:
    move = Sim3(2.0, turned(40), np.array([1.0, 2.0, 3.0]))
    for error in errors_of([move.camera(c) for c in TRUE][::-1], TRUE):
        assert error.shape == (28,) and error.max() < 1e-4


def test_a_turned_camera_and_an_absent_one_count_in_their_pairs_alone() -> None:
    R = turned(3) @ TRUE[2].R
    found = [*TRUE[:2], replace(TRUE[2], R=R, t=-R @ TRUE[2].center), *TRUE[3:7]]
    rotation, _ = errors_of(found, TRUE)
    i, j = np.triu_indices(8, 1)
    absent, off = (i == 7) | (j == 7), ((i == 2) | (j == 2)) & (j != 7)
    assert (rotation[absent] == 180).all()
    np.testing.assert_allclose(rotation[off], 3, atol=1e-6)
    assert rotation[~absent & ~off].max() < 1e-6
    assert all((error == 180).all() for error in errors_of(found[:1], TRUE))
    together = [replace(c, t=-c.R @ TRUE[0].center) for c in TRUE]
    assert all((error == 180).all() for error in errors_of(together, TRUE))


def test_estimators_see_the_light_that_there_is_without_the_pixels_pattern(shards: Path) -> None:
    (file,) = (f for f in open_folder(shards) if f.facts.hidden)
    burst, rng = file.read(2), np.random.default_rng(0)
    still = burst.keys[0, :8]
    for light in (0.25, 1.0):
        sight = see(burst, file, light, 401, rng)
        assert len(sight.cameras) == 8 and sight.inputs.shape == (8, 4, 61, 96)
        expected = still * file.facts.radiance_gain * light
        assert np.sqrt(np.mean((sight.means - expected) ** 2)) < 0.004 + 0.02 * light
        assert np.median(np.abs(sight.intervals / expected - 1)) < 0.2


def test_the_table_has_shares_of_pairs_in_each_condition(shards: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr(dark, "LIGHTS", (1.0, 1 / 4096))
    monkeypatch.setattr(dark, "TICKS", (41,))
    monkeypatch.setattr(dark, "VIEWS", 6)  # 15 pairs instead of 28
    assert dark_poses(shards, bursts=1, out=tmp_path / "out") == 0
    rows = json.loads((tmp_path / "out/poses.json").read_text())["rows"]
    assert [row["world"] for row in rows] == ["toy-12"] * 2 * len(ESTIMATORS)
    assert all(len(row["rotation_deg"]) == len(row["direction_deg"]) == 15 for row in rows)
    _, _, bright, black = (tmp_path / "out/poses.md").read_text().splitlines()
    assert bright == "| 1 | 2 |" + " 100 % / 100 % |" * len(ESTIMATORS)  # within 1 and 5 degrees
    assert black == "| 1/4096 | 2 |" + " 0 % / 0 % |" * len(ESTIMATORS)
    assert (tmp_path / "out/poses.png").stat().st_size > 1000
    assert "1/1 arrays" in capsys.readouterr().out
    monkeypatch.setattr(dark, "see", None)  # an array that is done is not measured again
    assert dark_poses(shards, bursts=1, out=tmp_path / "out") == 0
    assert json.loads((tmp_path / "out/poses.json").read_text())["rows"] == rows
    with pytest.raises(TypeError):  # with another seed it is
        dark_poses(shards, bursts=1, seed=1, out=tmp_path / "out")


# ---------------------------------------------------------------- points


def test_errors_are_relative_to_the_distance_and_ranked_by_sureness() -> None:
    true = np.array([[2.0, 4.0, 5.0, np.inf]])
    inverse = np.array([[1 / 2.0, 1 / 4.4, 1 / 6.0, 1.0]], np.float32)  # off by 0, 10 and 20 %, and nothing
    found = points.errors_of((inverse, np.array([[0.9, 0.5, 0.1, 1.0]], np.float32)), true)
    assert found == pytest.approx({"error": 0.1, "surer": 0.05, "rank": 1.0}, abs=1e-3)
    assert points.errors_of((inverse, np.array([[0.1, 0.5, 0.9, 0.0]], np.float32)), true)["rank"] == -1


def test_all_finders_see_a_bright_world(shards: Path) -> None:
    (file,) = (f for f in open_folder(shards) if f.facts.hidden)
    burst = file.read(2)
    sight = see(burst, file, 1.0, 401, np.random.default_rng(0))
    errors = []
    for find in points.SCENE_FINDERS.values():
        inverse, sure = find(sight.cameras, sight.inputs)
        assert inverse.shape == sure.shape == (61, 96)
        errors.append(points.errors_of((inverse, sure), burst.depth[0].astype(np.float64))["error"])
    assert max(errors) < 0.05 and errors[2] < errors[0], "both scores together are better than the cells' alone"


def test_the_table_of_points_has_a_line_for_each_condition(shards: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(points, "LIGHTS", (1.0, 1 / 4))
    monkeypatch.setattr(points, "TICKS", (41,))
    assert points.dark_points(shards, out=tmp_path / "out") == 0
    rows = json.loads((tmp_path / "out" / "points.json").read_text())["rows"]
    assert [(row["world"], row["light"], row["points"]) for row in rows] == [
        ("toy-12", light, name) for light in (1.0, 1 / 4) for name in points.FINDERS
    ]
    _, _, bright, dim = (tmp_path / "out" / "points.md").read_text().splitlines()
    assert bright.startswith(f"| 1 | 2 | {rows[0]['error']:.1%} |") and dim.startswith("| 1/4 | 2 |")


def test_the_table_of_scenes_has_a_line_for_each(tmp_path: Path) -> None:
    scene = write_small_scene(tmp_path / "scene")
    with pytest.raises(UserError, match="geometry/cam_00/000040.exr"):
        points.dark_points(scenes=(scene,), out=tmp_path)
    depth, none = np.full((HEIGHT, WIDTH), 3.0, np.float32), np.zeros((HEIGHT, WIDTH), np.uint32)
    depth[:, :4] = np.inf
    write_geometry(scene / "geometry/cam_00/000040.exr", depth, none, np.zeros((*depth.shape, 2), np.float32), 2000.0)
    write_manifest(scene)
    assert points.dark_points(scenes=(scene,), out=tmp_path) == 0
    rows = json.loads((tmp_path / "scenes.json").read_text())["rows"]
    assert [(row["scene"], row["points"]) for row in rows] == [("pattern-0", name) for name in points.SCENE_FINDERS]
    assert all(row["error"] > 0 and 0 < row["px"] < 30 for row in rows)
    assert (tmp_path / "scenes.md").read_text().splitlines()[2].startswith(f"| pattern-0 | {rows[0]['error']:.1%} |")


def test_a_folder_without_hidden_arrays_at_rest_is_refused(tmp_path: Path) -> None:
    write_toy_shard(tmp_path, 12)
    for command, of in ((points.dark_points, ""), (dark_poses, " with arrays of more than 8 views at rest")):
        with pytest.raises(UserError, match=f"expected shards of hidden variants{of}"):
            command(tmp_path)
