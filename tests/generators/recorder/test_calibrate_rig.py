"""Calibration of an array from a moving chessboard: corners, bundle adjustment, and the command on simulated spikes."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from spike4dgs.benchmark.cli import main
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.pose_error import pose_errors
from spike4dgs.benchmark.scene.cameras import look_at
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.generators.recorder.profile.profile import read_calibration
from spike4dgs.generators.recorder.rig_calibration import calibrate_rig as rig_command
from spike4dgs.generators.recorder.rig_calibration.array_start import first_rig
from spike4dgs.generators.recorder.rig_calibration.board import Board, find_corners
from spike4dgs.generators.recorder.rig_calibration.board_clip import (
    DARK,
    WALL,
    WHITE,
    BoardMotion,
    array,
    draw_board,
    key_spacing,
    write_board_clip,
)
from spike4dgs.generators.recorder.rig_calibration.board_views import (
    BoardRecording,
    View,
    choose_views,
    common_cameras,
    make_image,
)
from spike4dgs.generators.recorder.rig_calibration.bundle_adjustment import (
    Freedom,
    Rig,
    Sightings,
    adjust,
    exp_so3,
    rms_px,
    trimmed,
)

WIDTH, HEIGHT = 160, 100
BOARD, MOTION = Board(), BoardMotion()
CAMERAS = array(WIDTH, HEIGHT)


def projected(camera, s, board=BOARD):
    """Corners of the board in an image, and whether the image has all of them."""
    R, t = MOTION.pose(s)
    uv, z = camera.project(board.corners @ R.T + t)
    assert (z > 0).all()
    return uv, bool(((uv > 3) & (uv < [camera.width - 3, camera.height - 3])).all())


# ------------------------------------------------------------ the board


@pytest.mark.parametrize(("columns", "rows", "square"), [(8, 6, 0.04), (5, 5, 0.04), (8, 2, 0.04), (8, 5, 0.0)])
def test_a_board_that_half_a_turn_does_not_change_is_refused(columns, rows, square):
    with pytest.raises(UserError, match="inner corners"):
        Board(columns, rows, square)


def test_a_drawn_board_is_the_mean_of_its_samples():
    camera, board = replace(CAMERAS[1], width=60, height=40, cx=30.0, cy=20.0, fx=70.0, fy=70.0), Board(4, 3, 0.05)
    R, t = MOTION.pose(0.17)
    y, x = (np.mgrid[: 4 * 40, : 4 * 60] + 0.5) / 4
    ray = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1) @ camera.R
    normal = R[:, 2]
    along = (t - camera.center) @ normal / (ray @ normal)
    a, b, _ = np.moveaxis((camera.center + along[..., None] * ray - t) @ R / board.square_m, -1, 0)
    a, b = a + 2.5, b + 2.0  # in squares from the board's top left corner
    image = np.where((np.floor(a) + np.floor(b)) % 2 == 0, DARK, WHITE)
    image = np.where((a < 0) | (a >= 5) | (b < 0) | (b >= 4), WHITE, image)
    image = np.where((a < -1) | (a >= 6) | (b < -1) | (b >= 5), WALL, image)
    expected = image.reshape(40, 4, 60, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(draw_board(camera, board, R, t), expected, atol=1e-6)
    assert {WALL, WHITE, DARK} <= set(np.round(expected, 6).ravel())  # all of it is in the image


def test_a_board_that_is_partly_behind_the_camera_is_drawn_where_it_is_seen():
    camera = look_at(
        "cam", np.array([0.0, -0.05, 0.0]), np.array([0.0, 1, 0]), np.array([0, 0, 1.0]), focal=40, width=40, height=24
    )
    floor = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # the board lies face up; part of it is behind the camera
    image = draw_board(camera, BOARD, floor, np.array([0.0, 0.0, -0.04]))
    assert (image[:12] == np.float32(WALL)).all() and {np.float32(WHITE), np.float32(DARK)} <= set(image[23])


@pytest.mark.parametrize("s", [0.0, 0.3, 0.75])
def test_corners_are_found_to_a_tenth_of_a_pixel_in_the_boards_order(s):
    camera = array(320, 200)[3]
    R, t = MOTION.pose(s)
    image = draw_board(camera, BOARD, R, t)
    uv, whole = projected(camera, s)
    assert whole
    found = find_corners(image, BOARD)
    assert np.sqrt(np.mean(np.sum((found - uv) ** 2, axis=1))) < 0.1
    upside_down = find_corners(image[::-1, ::-1], BOARD)  # half a turn of the camera
    assert np.abs([320, 200] - upside_down - found).max() < 0.2
    quarter = find_corners(np.rot90(image).copy(), BOARD)  # (u, v) -> (v, W - u)
    assert np.abs(np.stack([found[:, 1], 320 - found[:, 0]], 1) - quarter).max() < 0.2


def test_a_board_that_is_not_seen_whole_is_not_found():
    image = draw_board(CAMERAS[4], BOARD, *MOTION.pose(0.0))
    uv, _ = projected(CAMERAS[4], 0.0)
    covered = image.copy()
    covered[:, : int(uv[:, 0].min()) + 8] = WALL
    assert find_corners(covered, BOARD) is None
    assert find_corners(np.zeros((40, 60), np.float32), BOARD) is None


def test_keys_are_as_dense_as_the_board_is_fast():
    cameras, ticks = CAMERAS[::4], 4000
    spacing = key_spacing(cameras, BOARD, MOTION, ticks)
    assert 1 < spacing < 20
    at = [projected(c, s / ticks)[0] for c in cameras for s in range(0, ticks + spacing, spacing)]
    moved = np.linalg.norm(np.diff(np.reshape(at, (len(cameras), -1, 40, 2)), axis=1), axis=-1)
    assert 0.5 < moved.max() < 1.02
    assert key_spacing(cameras, BOARD, MOTION, 10**6) == 20 and key_spacing(cameras, BOARD, MOTION, 20) == 1


# ------------------------------------------------------------ bundle adjustment


def sightings_of(cameras, shares, noise_px, seed=0):
    rng = np.random.default_rng(seed)
    seen = [(c, v, *projected(camera, s)) for v, s in enumerate(shares) for c, camera in enumerate(cameras)]
    camera, view, uv = (np.array([row[k] for row in seen if row[3]]) for k in range(3))
    view = np.unique(view, return_inverse=True)[1]
    return Sightings(camera, view, uv + noise_px * rng.normal(size=uv.shape), np.ones(uv.shape[:2], bool))


def start(cameras, sightings):
    return first_rig(sightings, BOARD.corners, [c.id for c in cameras], (WIDTH, HEIGHT))


@pytest.fixture(scope="module")
def adjusted():
    cameras, shares = CAMERAS[::3], np.linspace(0, 1, 12)
    sightings = sightings_of(cameras, shares, 0.05)
    rig, reference = start(cameras, sightings)
    return cameras, sightings, rig, reference, adjust(rig, sightings, BOARD.corners, reference)


def test_rotations_are_those_of_their_vectors():
    w = np.random.default_rng(0).normal(size=(50, 3)) * np.geomspace(1e-9, 3, 50)[:, None]
    np.testing.assert_allclose(exp_so3(w), Rotation.from_rotvec(w).as_matrix(), atol=1e-12)


def moved(rig, x, reference):
    """The rig after changes of all free parameters, in an order of its own: plain, and by scipy's rotations."""
    n, views = len(rig.focal), len(rig.board_t)
    poses, rest = x[: 6 * (n - 1)].reshape(-1, 6), x[6 * (n - 1) :]
    focal, rest = rest[:n], rest[n:]
    middle, boards = rest[: 2 * n].reshape(n, 2), rest[2 * n :].reshape(views, 6)
    poses = np.insert(poses, reference, 0.0, axis=0)
    turn, board_turn = (Rotation.from_rotvec(p[:, :3]).as_matrix() for p in (poses, boards))
    R, t = turn @ rig.R, np.einsum("nij,nj->ni", turn, rig.t) + poses[:, 3:]
    board_R = board_turn @ rig.board_R
    board_t = np.einsum("nij,nj->ni", board_turn, rig.board_t) + boards[:, 3:]
    return Rig(rig.focal + focal, rig.middle + middle, R, t, board_R, board_t)


def test_the_adjustment_is_the_least_squares_solution_and_its_deviations_are_those_of_the_jacobian(adjusted):
    _, sightings, rig, reference, found = adjusted
    n, views = len(rig.focal), len(rig.board_t)

    def residuals(x):
        return moved(found.rig, x, reference).residuals(sightings, BOARD.corners).ravel()

    def cost(r):
        return float(np.sum(r.residuals(sightings, BOARD.corners) ** 2))

    size = 6 * (n - 1) + 3 * n + 6 * views
    scale = np.r_[np.full(6 * (n - 1), 1e-2), np.full(3 * n, 10.0), np.full(6 * views, 1e-2)]
    solution = least_squares(residuals, np.zeros(size), x_scale=scale, ftol=1e-12, xtol=1e-12, gtol=1e-12)
    assert cost(found.rig) < 0.8 * cost(rig)
    assert cost(found.rig) <= 2 * solution.cost * (1 + 1e-6)
    variance = 2 * solution.cost / (sightings.uv.size - size)
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
    cameras_found = rig_command.levelled(found.rig, [c.id for c in cameras], size)
    errors = pose_errors(cameras_found, cameras)
    assert errors.translation_m.max() < 4 * found.center_m.max() < 0.01
    assert errors.rotation_deg.max() < 4 * found.turn_deg.max() < 1.0
    assert np.abs(found.rig.focal - [c.fx for c in cameras]).max() < 4 * found.focal_px.max()
    mean_up = -np.mean([c.R[1] for c in cameras_found], axis=0)
    assert np.abs(mean_up / np.linalg.norm(mean_up) - [0, 0, 1]).max() < 0.05
    assert np.mean([c.center[1] for c in cameras_found]) < -0.8  # behind what they look at, which is the origin


def test_what_is_not_free_stays(adjusted):
    cameras, sightings, rig, reference, free = adjusted
    fixed = adjust(rig, sightings, BOARD.corners, reference, Freedom(shared_focal=True, centered=True))
    np.testing.assert_array_equal(fixed.rig.middle, np.tile([WIDTH / 2, HEIGHT / 2], (len(cameras), 1)))
    steps = fixed.rig.focal - rig.focal
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
    assert np.ptp(fixed.focal_px) == 0 and (fixed.focal_px > 0).all()
    assert fixed.rig.t[reference] == pytest.approx(rig.t[reference])
    assert fixed.sigma_px > free.sigma_px


def test_corners_that_do_not_fit_are_left_out(adjusted):
    _, sightings, _, reference, found = adjusted
    uv = sightings.uv.copy()
    uv[3, 7] += [5.0, -4.0]
    spoiled = replace(sightings, uv=uv)
    rough = adjust(found.rig, spoiled, BOARD.corners, reference)
    kept = trimmed(rough.rig, spoiled, BOARD.corners)
    assert not kept.used[3, 7] and kept.used.mean() > 0.99
    again = adjust(rough.rig, kept, BOARD.corners, reference)
    assert rms_px(again.rig, kept, BOARD.corners) == pytest.approx(
        rms_px(found.rig, sightings, BOARD.corners), rel=0.05
    )


def test_cameras_that_saw_too_little_or_nothing_together_are_named():
    cameras, shares = CAMERAS[:2], np.linspace(0, 1, 12)
    sightings = sightings_of(cameras, shares, 0.0)
    few = sightings.of((sightings.camera == 0) | (sightings.view < 3))
    with pytest.raises(UserError, match=r"camera cam_01: expected the board in 4 views, found \d"):
        start(cameras, few)
    apart = sightings.of((sightings.view % 2 == 0) == (sightings.camera == 0))
    with pytest.raises(UserError, match="found cam_0. without"):
        start(cameras, apart)


def test_an_array_that_no_pinholes_explain_is_refused():
    cameras, shares = CAMERAS[:3], np.linspace(0, 1, 12)
    sightings = sightings_of(cameras, shares, 0.0)
    late = sightings.uv.copy()
    late[sightings.camera == 1] += 8 * np.sin(sightings.view[sightings.camera == 1])[:, None, None]  # another clock
    with pytest.raises(UserError, match="reprojection error below 1 px"):
        rig_command.calibrate_array(
            replace(sightings, uv=late), BOARD, [c.id for c in cameras], (WIDTH, HEIGHT), Freedom()
        )


# ------------------------------------------------------------ recordings


def stream(n_ticks=50, width=16, gaps=()):
    return SpikeStream(pack(np.ones((n_ticks, 8, width))), width, 8, 2e4, gaps=gaps)


def test_views_are_spread_over_the_clips_and_images_with_lost_ticks_are_none():
    gap = Gap("b", 30, 5, "overflow")
    recordings = [
        BoardRecording("one", {"a": stream(), "b": stream(gaps=(gap,))}, {}),
        BoardRecording("two", {"a": stream(20)}, {}),
    ]
    views = choose_views(recordings, 6, 10)
    assert views == [View(0, 0, 10), View(0, 20, 30), View(0, 40, 50), View(1, 0, 10), View(1, 5, 15), View(1, 10, 20)]
    assert make_image(recordings[0], "b", View(0, 20, 30)).min() == 1.0
    assert make_image(recordings[0], "b", View(0, 21, 31)) is None
    assert make_image(recordings[0], "b", View(0, 34, 44)) is None
    assert make_image(recordings[0], "a", View(0, 34, 44)) is not None
    with pytest.raises(UserError, match="two: expected a window of 1 to 20 ticks"):
        choose_views(recordings, 6, 30)


def test_clips_of_different_arrays_are_refused():
    one = BoardRecording("one", {"b": stream(), "a": stream()}, {})
    assert common_cameras([one, one]) == (("a", "b"), (16, 8))
    for other in ({"a": stream()}, {"a": stream(), "b": stream(width=24)}):
        with pytest.raises(UserError, match="the same cameras of one size"):
            common_cameras([one, BoardRecording("two", other, {})])


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Four of the nine cameras, 0.3 s: the board is so fast that its image blurs over a pixel."""
    return write_board_clip(tmp_path_factory.mktemp("board") / "clip", CAMERAS[::2][:4], BOARD, MOTION, 6000, seed=1)


def test_the_command_finds_the_array_from_spikes(clip, tmp_path, capsys):
    arguments = ["calibrate-rig", str(clip), "--out", str(tmp_path), "--views", "12", "--window-ticks", "40"]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    report = json.loads((tmp_path / "report.json").read_text())
    truth = open_scene(clip).cameras
    found = read_calibration(tmp_path / "calibration.toml", WIDTH, HEIGHT)
    assert list(found) == list(truth)
    errors = pose_errors(list(found.values()), list(truth.values()))
    assert report["reprojection_px"] < 0.2
    assert errors.rotation_deg.max() < 0.3 and errors.translation_m.max() < 0.003
    against = report["against_clip"]
    assert against["translation_max_m"] == pytest.approx(errors.translation_m.max())
    assert against["scale"] < 0.01 and against["focal_max"] < 0.01 and against["principal_point_max_px"] < 2
    assert "against the cameras that the clip states" in printed and "cam_06" in printed
    assert report["views"] == {"looked_at": 12, "with_board": 12, "window_ticks": 40}
    assert (tmp_path / "corners.png").stat().st_size > 20_000


def test_the_command_says_what_to_do(clip, tmp_path, capsys):
    assert main(["calibrate-rig", "--out", str(tmp_path)]) == 2
    assert "record the board" in capsys.readouterr().err
    assert main(["calibrate-rig", str(clip), "--out", str(tmp_path), "--views", "2"]) == 2
    assert "raise --views" in capsys.readouterr().err
    assert main(["calibrate-rig", str(clip), "--out", str(tmp_path), "--views", "1", "--columns", "14"]) == 2
    assert "check --columns and --rows (inner corners)" in capsys.readouterr().err


def test_a_board_clip_is_a_scene_and_nothing_is_overwritten(tmp_path, capsys):
    arguments = ["board-clip", "--out", str(tmp_path / "b"), "--seconds", "0.002", "--width", "32", "--height", "20"]
    assert main(arguments) == 0
    scene = open_scene(tmp_path / "b")
    assert (scene.n_ticks, len(scene.cameras), scene.meta["source"]["square_m"]) == (40, 9, 0.04)
    assert main(arguments) == 2
    assert main([*arguments[:2], str(tmp_path / "c"), "--seconds", "0.00001"]) == 2
    assert "at least 5e-05, one tick" in capsys.readouterr().err
