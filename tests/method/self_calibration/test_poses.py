"""Poses near given ones, on the toy world's mean images: told to be right where they are, repaired where not."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from clock_world import ClockWorld
from scipy.spatial.transform import Rotation
from toy_world import few_views

from spike4dgs.benchmark.metrics.pose_error import align_cameras, angle_deg
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.self_calibration.pose_adjustment import AdjustSettings, Tracks, adjust, triangulated
from spike4dgs.method.self_calibration.poses import check_poses, pose_of_another

WORLD = ClockWorld(width=120, height=76, n_ticks=96, travel=0.1)
SCENE = WORLD.training
FEW = few_views(SCENE, 0, 2, 3, 5, 7)  # 10 pairs, of 28


def off(cameras: Sequence[Camera], degrees: float, seed: int = 0) -> tuple[Camera, ...]:
    """Cameras turned about random axes, at their places."""
    rng, moved = np.random.default_rng(seed), []
    for camera in cameras:
        axis = rng.normal(size=3)
        R = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix() @ camera.R
        moved.append(replace(camera, R=R, t=-R @ camera.center))
    return tuple(moved)


def px_off(cameras: Sequence[Camera], true: Sequence[Camera]) -> float:
    """Median distance of projections of the wall at 4 m, all aligned to the true cameras."""
    align = align_cameras(cameras, true)
    u, v = np.meshgrid(np.arange(10, 120, 20.0), np.arange(10, 76, 20.0))
    errors = []
    for camera, other in zip(cameras, true, strict=True):
        uv = np.stack([u.ravel(), v.ravel()], axis=1)
        points = other.unproject(uv, np.full(len(uv), 4.0))
        errors.append(np.linalg.norm(align.camera(camera).project(points)[0] - uv, axis=1))
    return float(np.median(errors))


@pytest.fixture(scope="module")
def synthetic() -> tuple[Tracks, np.ndarray]:
    """Exact observations of 200 points by all cameras; a tenth of them are wrong by up to 20 px."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.2, -0.5, 0.0], [1.2, 1.5, 1.2], (200, 3))
    uv = np.concatenate([c.project(points)[0] for c in SCENE.cameras])
    wrong = rng.random(len(uv)) < 0.1
    uv = uv + wrong[:, None] * rng.uniform(-20, 20, uv.shape)
    camera, point = np.divmod(np.arange(len(uv)), len(points))
    return Tracks(camera, point, uv), points


def test_rays_meet_in_the_points() -> None:
    points = np.random.default_rng(0).uniform([-1, -0.5, 0.1], [1, 1.5, 1.0], (20, 3))
    uv = np.concatenate([c.project(points)[0] for c in SCENE.cameras])
    camera, point = np.divmod(np.arange(len(uv)), len(points))
    np.testing.assert_allclose(triangulated(SCENE.cameras, Tracks(camera, point, uv)), points, atol=1e-4)


@pytest.mark.parametrize("degrees", [0.1, 1.0, 2.0])
def test_turned_cameras_come_back(synthetic: tuple[Tracks, np.ndarray], degrees: float) -> None:
    given = off(SCENE.cameras, degrees)
    found = adjust(given, synthetic[0], AdjustSettings())
    assert px_off(found.cameras, SCENE.cameras) < 0.02 * max(1, degrees) < px_off(given, SCENE.cameras)
    assert np.median(found.errors) < 0.02


def test_cameras_that_are_not_free_stay(synthetic: tuple[Tracks, np.ndarray]) -> None:
    given = (*SCENE.cameras[:-1], off(SCENE.cameras[-1:], 1.0)[0])
    found = adjust(given, synthetic[0], AdjustSettings(), [False] * (len(given) - 1) + [True])
    assert found.cameras[:-1] == given[:-1]
    assert float(angle_deg(found.cameras[-1].R @ SCENE.cameras[-1].R.T)) < 0.02


def test_right_poses_are_told_to_be_right_and_wrong_ones_are_repaired() -> None:
    assert not check_poses(FEW).wrong
    given = off(FEW.cameras, 1.0)
    found = check_poses(replace(FEW, cameras=given))
    assert found.wrong and found.given_px > 0.6 and set(found.camera_px) == {c.id for c in given}
    assert px_off(found.cameras, FEW.cameras) < 0.3 * px_off(given, FEW.cameras)


def test_a_held_out_camera_finds_its_place_among_the_others() -> None:
    (given,) = off([WORLD.held_out], 1.0)
    found = pose_of_another(FEW, given, WORLD.stream(WORLD.held_out, 4))
    assert float(angle_deg(found.R @ WORLD.held_out.R.T)) < 0.1
