"""Bundle adjustment of an array against scipy, and its errors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from board_array import BOARD, CAMERAS, HEIGHT, WIDTH, projected
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.pose_error import pose_errors
from spike4dgs.generators.recorder.rig_calibration import array_calibration
from spike4dgs.generators.recorder.rig_calibration.board import Board
from spike4dgs.generators.recorder.rig_calibration.bundle_adjustment import (
    Detections,
    Freedom,
    Rig,
    adjust,
    rms_px,
    trimmed,
)
from spike4dgs.generators.recorder.rig_calibration.initial_rig import estimate_rig


def detections_of(cameras, shares, noise_px, seed=0):
    rng = np.random.default_rng(seed)
    seen = [(c, v, *projected(camera, s)) for v, s in enumerate(shares) for c, camera in enumerate(cameras)]
    camera, view, uv = (np.array([row[k] for row in seen if row[3]]) for k in range(3))
    view = np.unique(view, return_inverse=True)[1]
    return Detections(camera, view, uv + noise_px * rng.normal(size=uv.shape), np.ones(uv.shape[:2], bool))


def initial(cameras, detections):
    return estimate_rig(detections, BOARD.corners, [c.id for c in cameras], (WIDTH, HEIGHT))


@pytest.fixture(scope="module")
def adjusted():
    cameras, shares = CAMERAS[::3], np.linspace(0, 1, 12)
    detections = detections_of(cameras, shares, 0.05)
    rig, reference = initial(cameras, detections)
    return cameras, detections, rig, reference, adjust(rig, detections, BOARD.corners, reference)


def moved(rig, x, reference):
    """Return the rig after changes of all free parameters, in another order and with scipy's rotations."""
    n, views = len(rig.focal), len(rig.board_t)
    poses, rest = x[: 6 * (n - 1)].reshape(-1, 6), x[6 * (n - 1) :]
    focal, rest = rest[:n], rest[n:]
    principal, boards = rest[: 2 * n].reshape(n, 2), rest[2 * n :].reshape(views, 6)
    poses = np.insert(poses, reference, 0.0, axis=0)
    turn, board_turn = (Rotation.from_rotvec(p[:, :3]).as_matrix() for p in (poses, boards))
    R, t = turn @ rig.R, np.einsum("nij,nj->ni", turn, rig.t) + poses[:, 3:]
    board_R = board_turn @ rig.board_R
    board_t = np.einsum("nij,nj->ni", board_turn, rig.board_t) + boards[:, 3:]
    return Rig(rig.focal + focal, rig.principal + principal, R, t, board_R, board_t)


def test_the_adjustment_is_the_least_squares_solution_and_its_deviations_are_those_of_the_jacobian(adjusted):
    _, detections, rig, reference, found = adjusted
    n, views = len(rig.focal), len(rig.board_t)

    def residuals(x):
        return moved(found.rig, x, reference).residuals(detections, BOARD.corners).ravel()

    def cost(r):
        return float(np.sum(r.residuals(detections, BOARD.corners) ** 2))

    size = 6 * (n - 1) + 3 * n + 6 * views
    scale = np.r_[np.full(6 * (n - 1), 1e-2), np.full(3 * n, 10.0), np.full(6 * views, 1e-2)]
    solution = least_squares(residuals, np.zeros(size), x_scale=scale, ftol=1e-12, xtol=1e-12, gtol=1e-12)
    assert cost(found.rig) < 0.8 * cost(rig)
    assert cost(found.rig) <= 2 * solution.cost * (1 + 1e-6)
    variance = 2 * solution.cost / (detections.uv.size - size)
    assert found.sigma_px == pytest.approx(math.sqrt(variance), rel=1e-5)
    assert 0.04 < found.sigma_px < 0.06  # the noise that was added
    deviation = np.sqrt(np.diag(variance * np.linalg.inv(solution.jac.T @ solution.jac)))
    poses = np.insert(deviation[: 6 * (n - 1)].reshape(-1, 6), reference, 0.0, axis=0)
    np.testing.assert_allclose(found.center_m, np.linalg.norm(poses[:, 3:], axis=1), rtol=1e-3)
    np.testing.assert_allclose(found.turn_deg, np.degrees(np.linalg.norm(poses[:, :3], axis=1)), rtol=1e-3)
    np.testing.assert_allclose(found.focal_px, deviation[6 * (n - 1) :][:n], rtol=1e-3)


def test_poses_come_out_within_their_deviations(adjusted):
    cameras, _, rig, reference, found = adjusted
    size = (WIDTH, HEIGHT)
    cameras_found = array_calibration.levelled(found.rig, [c.id for c in cameras], size)
    errors = pose_errors(cameras_found, cameras)
    assert errors.translation_m.max() < 4 * found.center_m.max() < 0.01
    assert errors.rotation_deg.max() < 4 * found.turn_deg.max() < 1.0
    assert np.abs(found.rig.focal - [c.fx for c in cameras]).max() < 4 * found.focal_px.max()
    mean_up = -np.mean([c.R[1] for c in cameras_found], axis=0)
    assert np.abs(mean_up / np.linalg.norm(mean_up) - [0, 0, 1]).max() < 0.05
    assert np.mean([c.center[1] for c in cameras_found]) < -0.8  # behind the origin, at which they look


def test_lenses_are_estimated_as_scipy_would_and_only_on_request():
    lens = (-0.5, 0.3, 0.0, 0.0, 0.0)
    cameras, shares = [replace(c, distortion=lens) for c in CAMERAS[::3]], np.linspace(0, 1, 12)
    detections = detections_of(cameras, shares, 0.05)
    rig, reference = initial(cameras, detections)
    pinholes = adjust(rig, detections, BOARD.corners, reference)
    found = adjust(rig, detections, BOARD.corners, reference, Freedom(distortion=True))
    assert pinholes.rig.lens is None and pinholes.sigma_px > 1.5 * found.sigma_px
    assert 0.045 < found.sigma_px < 0.055  # the noise that was added
    assert pinholes.lens is None
    off = found.rig.lens - lens[:2]
    assert max(k @ np.linalg.solve(covariance, k) for k, covariance in zip(off, found.lens, strict=True)) < 16
    n, at = len(cameras), found.rig

    def residuals(x):
        step = x.reshape(n, 3)
        other = replace(at, focal=at.focal + step[:, 0], lens=at.lens + step[:, 1:])
        return other.residuals(detections, BOARD.corners).ravel()

    cost = np.sum(residuals(np.zeros(3 * n)) ** 2)
    solution = least_squares(residuals, np.zeros(3 * n), x_scale=np.tile([10.0, 0.1, 0.1], n), xtol=1e-14, ftol=1e-14)
    assert cost <= 2 * solution.cost * (1 + 1e-8)
    found = array_calibration.levelled(at, [c.id for c in cameras], (WIDTH, HEIGHT))
    for camera, true in zip(found, cameras, strict=True):
        assert camera.distortion[2:] == (0.0, 0.0, 0.0)
        corners = np.array([[10.0, 10], [150, 10], [10, 90], [150, 90], [80, 50]])
        rays = camera.normalized(corners) - camera.normalized(corners[-1:])
        expected = true.normalized(corners) - true.normalized(corners[-1:])
        assert np.abs(rays - expected).max() * true.fx < 0.5  # px; the board does not reach the corners


def test_lenses_that_the_corners_leave_open_are_refused(monkeypatch):
    """A small board in the middle of the images fits well with lenses of any kind."""
    rng, board, base = np.random.default_rng(1), Board(8, 5, 0.01), np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0.0]])
    cameras, rows = CAMERAS[::3], []
    for v in range(10):
        tilt = rng.uniform([-35, -35, -20], [35, 35, 20])
        turn = Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
        points = board.corners @ (turn @ base).T + rng.uniform(-0.01, 0.01, 3)
        rows += [(c, v, camera.project(points)[0]) for c, camera in enumerate(cameras)]
    camera, view, uv = (np.array([row[k] for row in rows]) for k in range(3))
    seen = Detections(camera, view, uv + 0.01 * rng.normal(size=uv.shape), np.ones(uv.shape[:2], bool))
    arguments = seen, board, [c.id for c in cameras], (WIDTH, HEIGHT), Freedom(distortion=True)
    fix = "move the board into the corners of all images, or leave --distortion out"
    with pytest.raises(UserError, match=f"expected lenses to 1 px in the corners .* one standard deviation.*; {fix}"):
        array_calibration.calibrate_array(*arguments)
    monkeypatch.setattr(array_calibration, "WORST_LENS_PX", np.inf)
    with pytest.raises(UserError, match=f"a lens of cam_0. whose model holds up to the image's corners.*; {fix}"):
        array_calibration.calibrate_array(*arguments)


def test_fixed_parameters_stay(adjusted):
    cameras, detections, rig, reference, free = adjusted
    fixed = adjust(rig, detections, BOARD.corners, reference, Freedom(shared_focal=True, centered=True))
    np.testing.assert_array_equal(fixed.rig.principal, np.tile([WIDTH / 2, HEIGHT / 2], (len(cameras), 1)))
    assert np.ptp(rig.focal) > 0 and np.ptp(fixed.rig.focal) == np.ptp(fixed.focal_px) == 0
    assert (fixed.focal_px > 0).all()
    assert fixed.rig.t[reference] == pytest.approx(rig.t[reference])
    assert fixed.sigma_px > free.sigma_px


def test_corners_that_do_not_fit_are_left_out(adjusted):
    _, detections, _, reference, found = adjusted
    uv = detections.uv.copy()
    uv[3, 7] += [5.0, -4.0]
    spoiled = replace(detections, uv=uv)
    rough = adjust(found.rig, spoiled, BOARD.corners, reference)
    kept = trimmed(rough.rig, spoiled, BOARD.corners)
    assert not kept.used[3, 7] and kept.used.mean() > 0.99
    again = adjust(rough.rig, kept, BOARD.corners, reference)
    assert rms_px(again.rig, kept, BOARD.corners) == pytest.approx(
        rms_px(found.rig, detections, BOARD.corners), rel=0.05
    )


def test_cameras_with_too_few_or_no_common_views_are_named():
    cameras, shares = CAMERAS[:2], np.linspace(0, 1, 12)
    detections = detections_of(cameras, shares, 0.0)
    few = detections.of((detections.camera == 0) | (detections.view < 3))
    with pytest.raises(UserError, match=r"camera cam_01: expected the board in 4 views, found \d"):
        initial(cameras, few)
    apart = detections.of((detections.view % 2 == 0) == (detections.camera == 0))
    with pytest.raises(UserError, match="found cam_0. without"):
        initial(cameras, apart)


@pytest.mark.parametrize("offset_px", [6.0, 12.0, 25.0])
def test_a_view_whose_corners_all_go_is_left_out(offset_px):
    """Two cameras see it, and one finds the board elsewhere: no pose explains both."""
    cameras = CAMERAS[:6]
    detections = detections_of(cameras, np.linspace(0, 1, 13), 0.05)
    two = (detections.view != 5) | (detections.camera < 2)
    detections = detections.of(two)
    uv = detections.uv.copy()
    uv[(detections.view == 5) & (detections.camera == 1)] += [offset_px, 0.0]
    names, shown = [c.id for c in cameras], replace(detections, uv=uv)
    found = array_calibration.calibrate_array(shown, BOARD, names, (WIDTH, HEIGHT), Freedom())
    assert found.reprojection_px < 0.1 and not found.detections.used[found.detections.view == 5].all()


def test_a_camera_whose_corners_are_left_out_is_named():
    """One of nine is late: the others hide it in the mean of all."""
    cameras, shares = CAMERAS[:9], np.linspace(0, 1, 13)
    detections = detections_of(cameras, shares, 0.05)
    late, slow = detections.uv.copy(), detections.camera == 4
    late[slow] += 8 * np.sin(detections.view[slow])[:, None, None]
    mixed = replace(detections, uv=late)
    with pytest.raises(UserError, match=f"other cameras than {cameras[4].id} agree"):
        array_calibration.calibrate_array(mixed, BOARD, [c.id for c in cameras], (WIDTH, HEIGHT), Freedom())


def test_an_array_that_no_pinholes_explain_is_refused():
    cameras, shares = CAMERAS[:3], np.linspace(0, 1, 12)
    detections = detections_of(cameras, shares, 0.0)
    late = detections.uv.copy()
    late[detections.camera == 1] += 8 * np.sin(detections.view[detections.camera == 1])[:, None, None]  # another clock
    with pytest.raises(UserError, match="reprojection error below 1 px"):
        array_calibration.calibrate_array(
            replace(detections, uv=late), BOARD, [c.id for c in cameras], (WIDTH, HEIGHT), Freedom()
        )


@pytest.mark.parametrize(("tilt_deg", "noise_px"), [(1.0, 0.05), (0.0, 0.0)])
def test_a_board_that_is_hardly_tilted_leaves_the_focal_length_open(tilt_deg: float, noise_px: float) -> None:
    """Of a board parallel to the image, only the ratio of focal length and distance is known, however sharp it is."""
    rng, focal, size, views = np.random.default_rng(0), 600.0, (400, 250), 12
    turns = Rotation.from_euler("xyz", rng.uniform(-1, 1, (views, 3)) * [tilt_deg, tilt_deg, 20], degrees=True)
    turns = turns.as_matrix()
    places = rng.uniform([-0.05, -0.05, 1.3], [0.05, 0.05, 1.7], (views, 3))
    first = BOARD.corners @ turns.transpose(0, 2, 1) + places[:, None]
    second = first @ Rotation.from_euler("y", 5 * tilt_deg, degrees=True).as_matrix() - [0.12, 0, 0]
    x = np.concatenate([first, second])
    uv = focal * x[..., :2] / x[..., 2:] + np.array(size) / 2 + noise_px * rng.normal(size=(*x.shape[:2], 2))
    camera, view = np.repeat([0, 1], views), np.tile(np.arange(views), 2)
    detections = Detections(camera, view, uv, np.ones(uv.shape[:2], bool))
    rig, reference = estimate_rig(detections, BOARD.corners, ["a", "b"], size)
    found = adjust(rig, detections, BOARD.corners, reference)
    assert (np.abs(found.rig.focal - focal) < 4 * found.focal_px).all()
    with pytest.raises(UserError, match=r"focal lengths to 3%.* for [ab]; tilt the board"):
        array_calibration.calibrate_array(detections, BOARD, ["a", "b"], size, Freedom())
