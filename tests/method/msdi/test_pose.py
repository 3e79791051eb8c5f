"""Poses from points: exact, noisy, with unknown focal length, and without any solution."""

import numpy as np
import pytest
import torch
from hard_case import HardCase
from toy_world import ToyWorld

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.metrics.pose_error import angle_deg
from spike4dgs.method.msdi import Estimate
from spike4dgs.method.msdi.pose import focal_from_points, poses_of, solve_poses

WORLD = ToyWorld(width=64, height=40)
K = np.stack([c.K for c in WORLD.cameras])
_BACK = np.linalg.inv(WORLD.cameras[0].w2c)
TRUE = [c.w2c @ _BACK for c in WORLD.cameras]  # from view 0's frame


def seen(scale: float = 1.0) -> Float64:
    """Return the points that pixels of all views see, [9, H, W, 3] in view 0's frame."""
    maps = []
    for camera in WORLD.cameras:
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        depth = WORLD.trace(camera, 0.5)[1]
        world = camera.unproject(np.column_stack([u.ravel(), v.ravel()]), depth.ravel())
        first = world @ WORLD.cameras[0].R.T + WORLD.cameras[0].t
        maps.append(scale * first.reshape(*depth.shape, 3))
    return np.stack(maps)


def errors(w2c: Float64 | None, true: Float64, scale: float = 1.0) -> tuple[float, float]:
    """Return degrees, and the distance of the centres in true metres."""
    assert w2c is not None
    turn = float(angle_deg(w2c[:3, :3] @ true[:3, :3].T))
    centres = [-m[:3, :3].T @ m[:3, 3] / s for m, s in ((w2c, scale), (true, 1.0))]
    return turn, float(np.linalg.norm(centres[0] - centres[1]))


SURE = np.ones((9, 40, 64))


@pytest.mark.hard_case(
    asked="poses from exact points in units of {scale} m", twin="the true poses", unit="degrees", tolerance=1e-4
)
@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e4])
def test_exact_points_give_exact_poses_at_any_scale(hard_case: HardCase, scale: float) -> None:
    poses = solve_poses(seen(scale), SURE, K, hard_case.seed)
    assert np.array_equal(poses[0].w2c, np.eye(4))
    for i, (pose, true) in enumerate(zip(poses, TRUE, strict=True)):
        turn, off = errors(pose.w2c, true, scale)
        assert pose.found and pose.reason == "" and pose.focal_px is None and off < 1e-5
        hard_case.close(turn, 0.0, f"view {i}")


def test_noise_and_outliers_of_low_and_high_confidence() -> None:
    rng = np.random.default_rng(0)
    points = seen()
    points += 0.01 * rng.normal(size=points.shape)
    wrong = rng.random(SURE.shape) < 0.5
    points[wrong] += rng.normal(size=(int(wrong.sum()), 3))
    confidence = np.where(wrong & (rng.random(SURE.shape) < 0.5), 1.0, 2.0 + rng.random(SURE.shape))
    poses = solve_poses(points, confidence, K)
    for pose, true in zip(poses, TRUE, strict=True):
        turn, off = errors(pose.w2c, true)
        assert turn < 0.2 and off < 0.02


def test_unknown_focal_length_is_found_from_view_0() -> None:
    rng = np.random.default_rng(1)
    points = seen()
    points *= 1 + 0.003 * rng.normal(size=(*SURE.shape, 1))
    for pose, true in zip(solve_poses(points, SURE, None), TRUE, strict=True):
        turn, off = errors(pose.w2c, true)
        assert pose.focal_px == pytest.approx(WORLD.cameras[0].fx, rel=0.01) and turn < 0.3 and off < 0.05


def test_focal_length_of_points_with_outliers() -> None:
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-1, 1, (400, 2)), rng.uniform(2, 4, 400)])
    offsets = 123.0 * points[:, :2] / points[:, 2:]
    assert focal_from_points(points, offsets) == pytest.approx(123, abs=1e-6)
    offsets[:80] += rng.normal(0, 40, (80, 2))
    points[80] = [0.1, 0.2, -1.0]  # behind the camera
    assert focal_from_points(points, offsets) == pytest.approx(123, abs=2)
    assert focal_from_points(points, -offsets) is None
    assert focal_from_points(-points, offsets) is None and focal_from_points(points[:0], offsets[:0]) is None


def test_bad_views_have_no_pose_and_say_why_and_leave_the_others() -> None:
    rng = np.random.default_rng(2)
    points = seen()
    points[2] = rng.normal(size=points[2].shape) * 5  # nonsense
    points[3] = np.nan
    points[4] = 1.0  # all equal
    points[5, ..., 1:] = [0.5, 3.0]  # on a line
    points[6] = -points[6]  # mirrored through the camera
    points[7, :30] = np.nan  # a part is enough
    points[8, 2, 3] = np.inf
    poses = solve_poses(points, SURE, K)
    assert [p.found for p in poses] == [True, True, False, False, False, False, poses[6].found, True, True]
    assert all(p.w2c is None and p.reason for p in poses[2:6])
    assert poses[3].reason == "0 usable points, fewer than 6"
    for i in (1, 7, 8):
        turn, off = errors(poses[i].w2c, TRUE[i])
        assert turn < 1e-3 and off < 1e-4


@pytest.mark.hard_case(
    asked="points that are NaN, equal, on a line, nonsense, infinite; no confidence",
    twin="the contract: no pose, and a reason", unit="views with a pose",
)  # fmt: skip
def test_points_of_no_pose(hard_case: HardCase) -> None:
    points = seen()[:2]
    bad = {str(value): np.full_like(points[1], value) for value in (np.nan, np.inf, 1.0, 1e300)}
    bad["on a line"] = points[1] * [1, 0, 0] + [0, 0.5, 3.0]
    bad["nonsense"] = 5 * hard_case.rng().normal(size=points[1].shape)
    found = {n: solve_poses(np.stack([points[0], p]), SURE[:2], K[:2], hard_case.seed)[1] for n, p in bad.items()}
    first, found["no confidence"] = solve_poses(points, np.full_like(SURE[:2], np.nan), K[:2])
    assert first.found
    posed = [name for name, pose in found.items() if pose.found or not pose.reason]
    hard_case.check(len(posed), f"poses of {', '.join(posed)}" if posed else f"no pose of {len(found)}")


def test_without_any_good_point_nothing_is_raised() -> None:
    for value in (np.nan, 0.0, -1.0, 1e300):
        poses = solve_poses(np.full((3, 8, 8, 3), value), np.ones((3, 8, 8)), None)
        assert [p.found for p in poses] == [False] * 3 and "focal" in poses[0].reason


def test_the_same_seed_gives_the_same_poses() -> None:
    rng = np.random.default_rng(3)
    points = seen()[:2].repeat(2, axis=1).repeat(2, axis=2)  # more than the solver takes: the seed chooses among them
    points += 0.05 * rng.normal(size=points.shape)
    finer = K[:2] * [[2], [2], [1]]
    a, b, c = (solve_poses(points, np.ones(points.shape[:3]), finer, seed)[1] for seed in (2**62, 2**62, 1))
    assert a.found and np.array_equal(a.w2c, b.w2c) and not np.array_equal(a.w2c, c.w2c)


def test_poses_of_a_batch() -> None:
    points = torch.tensor(np.stack([seen()[:2], seen(2.0)[:2]]), dtype=torch.float32)
    estimate = Estimate(points, torch.full((2, 2, 40, 64), 2.0), torch.zeros(2, 2, 40, 64))
    known = poses_of(estimate, np.stack([K[:2], K[:2]]))
    assert [len(p) for p in known] == [2, 2]
    assert errors(known[0][1].w2c, TRUE[1])[1] < 1e-3 and errors(known[1][1].w2c, TRUE[1], 2.0)[1] < 1e-3
    assert poses_of(estimate, None)[0][1].focal_px == pytest.approx(K[0, 0, 0], rel=1e-3)
