"""Poses from a rough guess of what view 0 sees: the toy world's truth, made wrong in known ways."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from toy_world import ToyWorld

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.pose_error import PoseErrors, pose_errors
from spike4dgs.method.msdi.training_data import points_of
from spike4dgs.method.pose_refinement import rigid_motion
from spike4dgs.method.starts import matched_poses as module
from spike4dgs.method.starts.matched_poses import Pose, Seen, bundle
from spike4dgs.method.starts.msdi import shrunk
from spike4dgs.method.starts.structure_from_motion import Mapping, clip_means

WORLD = ToyWorld(width=120, height=76, n_ticks=96, travel=0.1, seed=1)
SCENE = WORLD.training
FACTOR, SCALE = 2, 3.7


def guess(error: float) -> NDArray[np.float64]:
    """Points of view 0, at half the size and another scale, depths wrong by `error`; nothing is known of some rows."""
    camera = shrunk(SCENE.cameras[0], FACTOR)
    depth = WORLD.trace(camera, 0.5)[1]
    depth = depth * np.exp(error * np.random.default_rng(0).standard_normal(depth.shape))
    points = points_of(depth[None].astype(np.float32), camera.K[None], np.eye(4)[None])[0].astype(np.float64) / SCALE
    points[10:16] = np.nan
    return points


def solve(error: float = 0.1) -> Mapping:
    return bundle(SCENE, guess(error), FACTOR, clip_means(SCENE), 0)


def errors(found: Mapping) -> PoseErrors:
    assert [c.id for c in found.cameras] == [c.id for c in SCENE.cameras]
    return pose_errors(found.cameras, SCENE.cameras)


@pytest.fixture(scope="module")
def found() -> Mapping:
    return solve()


def test_a_guess_wrong_by_a_tenth_gives_good_poses(found: Mapping) -> None:
    summary = errors(found).summary()
    assert summary["rotation_max_deg"] < 0.3 and summary["translation_of_array"] < 0.03, summary
    assert all(c.fx == true.fx for c, true in zip(found.cameras, SCENE.cameras, strict=True))


def test_points_lie_on_the_surfaces(found: Mapping) -> None:
    uv, z = WORLD.held_out.project(found.points)
    u, v = np.floor(uv).astype(int).T
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u < 120) & (v < 76)
    depth = WORLD.trace(WORLD.held_out, 0.5)[1]
    assert inside.sum() > 100 and np.median(np.abs(z[inside] / depth[v[inside], u[inside]] - 1)) < 0.03


def test_how_wrong_the_guess_was_does_not_matter_in_the_end(found: Mapping) -> None:
    a, b = errors(found), errors(solve(0.2))
    assert np.abs(a.rotation_deg - b.rotation_deg).max() < 0.02


def test_a_view_that_begins_at_a_wrong_place_is_placed_again(found: Mapping, monkeypatch: pytest.MonkeyPatch) -> None:
    first = module._first_poses

    def one_wrong(seen: Seen, *args: object) -> list[Pose | None]:
        poses = first(seen, *args)  # type: ignore[arg-type]
        turn = rigid_motion(torch.tensor([0.0, 0.15, 0.0, 0.1, 0.0, 0.0], dtype=torch.float64)).numpy()
        R, t = poses[3] or pytest.fail("view 3 has no pose")
        poses[3] = turn[:3, :3] @ R, turn[:3, :3] @ t + turn[:3, 3]
        poses[5] = None
        return poses

    monkeypatch.setattr(module, "_first_poses", one_wrong)
    assert np.abs(errors(solve()).rotation_deg - errors(found).rotation_deg).max() < 0.05


def test_the_same_seed_gives_the_same_poses_and_nothing_stays_behind(
    found: Mapping, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    for a, b in zip(solve().cameras, found.cameras, strict=True):
        assert np.array_equal(a.w2c, b.w2c)
    assert not os.listdir(tmp_path)
    printed = capfd.readouterr()
    assert printed.out == printed.err == ""


def test_without_matches_no_view_is_placed() -> None:
    dark = bundle(SCENE, guess(0.1), FACTOR, 0 * clip_means(SCENE), 0)
    assert dark.cameras == () and len(dark.points) == 0
    with pytest.raises(UserError, match="MSDI on toy: expected all 8 views registered, found 0 of 8"):
        dark.of_all(SCENE, "MSDI")
    few = replace(dark, cameras=SCENE.cameras[:3])
    with pytest.raises(UserError, match="found 3 of 8"):
        few.of_all(SCENE, "MSDI")


def test_a_guess_of_nothing_places_no_view() -> None:
    assert bundle(SCENE, np.full_like(guess(0), np.nan), FACTOR, clip_means(SCENE), 0).cameras == ()
