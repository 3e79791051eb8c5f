"""Poses that features refine: the toy world's truth, made wrong in known ways."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_world import ToyWorld

from spike4dgs.benchmark.metrics.pose_error import PoseErrors, pose_errors
from spike4dgs.method.pose_refinement import rigid_motion
from spike4dgs.method.starts.matched_poses import Pose, bundle
from spike4dgs.method.starts.structure_from_motion import Mapping, clip_means

WORLD = ToyWorld(width=120, height=76, n_ticks=96, travel=0.1, seed=1, spread=0.05, views=(0, 2, 3, 5, 7))
SCALE = 3.7


def begin(off_deg: float = 1.5, off_m: float = 0.02) -> list[Pose | None]:
    """Poses in a frame of another scale, each turned and moved at random by so much."""
    rng, poses = np.random.default_rng(0), list[Pose | None]()
    for camera in WORLD.training.cameras:
        steps = [rng.standard_normal(3) for _ in range(2)]
        turn, move = (s / np.linalg.norm(s) * off for s, off in zip(steps, (np.radians(off_deg), off_m), strict=True))
        w2c = rigid_motion(torch.from_numpy(np.concatenate([turn, move]))).numpy() @ camera.w2c
        poses.append((w2c[:3, :3], w2c[:3, 3] / SCALE))
    return poses


def solve(poses: list[Pose | None]) -> Mapping:
    return bundle(WORLD.training, poses, clip_means(WORLD.training), 0)


def errors(found: Mapping) -> PoseErrors:
    assert [c.id for c in found.cameras] == [c.id for c in WORLD.training.cameras]
    return pose_errors(found.cameras, WORLD.training.cameras)


@pytest.fixture(scope="module")
def found() -> Mapping:
    return solve(begin())


def test_poses_that_are_off_by_degrees_become_good_ones_and_views_keep_their_intrinsics(found: Mapping) -> None:
    summary = errors(found).summary()
    assert summary["rotation_max_deg"] < 0.3 and summary["translation_of_array"] < 0.03, summary
    assert [c.fx for c in found.cameras] == pytest.approx([c.fx for c in WORLD.training.cameras])


def test_points_lie_on_the_surfaces(found: Mapping) -> None:
    off = WORLD.depth_errors(found.points)
    assert len(off) > 100 and np.median(off) < 0.03


def test_how_wrong_the_first_poses_were_does_not_matter_in_the_end(found: Mapping) -> None:
    a, b = errors(found), errors(solve(begin(0.5, 0.005)))
    assert np.abs(a.rotation_deg - b.rotation_deg).max() < 0.02


def test_a_view_that_begins_at_a_wrong_place_is_placed_again(found: Mapping) -> None:
    poses = begin()
    R, t = poses[3] or pytest.fail("view 3 has no pose")
    turn = rigid_motion(torch.tensor([0.0, 0.15, 0.0, 0.1, 0.0, 0.0], dtype=torch.float64)).numpy()
    poses[3] = turn[:3, :3] @ R, turn[:3, :3] @ t + turn[:3, 3]
    poses[4] = None
    assert np.abs(errors(solve(poses)).rotation_deg - errors(found).rotation_deg).max() < 0.05


def test_the_same_seed_gives_the_same_poses_and_nothing_stays_behind(
    found: Mapping, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    for a, b in zip(solve(begin()).cameras, found.cameras, strict=True):
        assert np.array_equal(a.w2c, b.w2c)
    assert not os.listdir(tmp_path)
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


def test_without_matches_or_first_poses_no_view_is_placed() -> None:
    dark = bundle(WORLD.training, begin(), 0 * clip_means(WORLD.training), 0)
    assert dark.cameras == () and len(dark.points) == 0
    assert solve([None] * 5).cameras == ()
