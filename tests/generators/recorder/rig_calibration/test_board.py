"""A chessboard: its rendering, and the detection of its corners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from board_array import BOARD, CAMERAS, projected

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import look_at
from spike4dgs.generators.recorder.rig_calibration.board import Board, find_corners
from spike4dgs.generators.recorder.rig_calibration.board_clip import (
    DARK,
    DISTANCE_M,
    WALL,
    WHITE,
    array,
    board_pose,
    key_spacing,
    render_board,
)


@pytest.mark.parametrize(("columns", "rows", "square"), [(8, 6, 0.04), (5, 5, 0.04), (8, 2, 0.04), (8, 5, 0.0)])
def test_a_board_that_half_a_turn_does_not_change_is_refused(columns, rows, square):
    with pytest.raises(UserError, match="inner corners"):
        Board(columns, rows, square)


def test_a_rendered_board_is_the_mean_of_its_samples():
    camera, board = replace(CAMERAS[1], width=60, height=40, cx=30.0, cy=20.0, fx=70.0, fy=70.0), Board(4, 3, 0.05)
    R, t = board_pose(0.17)
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
    np.testing.assert_allclose(render_board(camera, board, R, t), expected, atol=1e-6)
    assert {WALL, WHITE, DARK} <= set(np.round(expected, 6).ravel())  # all of it is in the image


def test_a_board_partly_behind_the_camera_is_rendered_in_front_of_it_only():
    camera = look_at(
        "cam", np.array([0.0, -0.05, 0.0]), np.array([0.0, 1, 0]), np.array([0, 0, 1.0]), focal=40, width=40, height=24
    )
    floor = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # the board lies face up; part of it is behind the camera
    image = render_board(camera, BOARD, floor, np.array([0.0, 0.0, -0.04]))
    assert (image[:12] == np.float32(WALL)).all() and {np.float32(WHITE), np.float32(DARK)} <= set(image[23])


@pytest.mark.parametrize("s", [0.0, 0.3, 0.75])
def test_corners_are_found_to_a_tenth_of_a_pixel_in_the_boards_order(s):
    camera = array(320, 200)[3]
    R, t = board_pose(s)
    image = render_board(camera, BOARD, R, t)
    uv, whole = projected(camera, s)
    assert whole
    found = find_corners(image, BOARD)
    assert np.sqrt(np.mean(np.sum((found - uv) ** 2, axis=1))) < 0.1
    upside_down = find_corners(image[::-1, ::-1], BOARD)  # half a turn of the camera
    assert np.abs([320, 200] - upside_down - found).max() < 0.2
    quarter = find_corners(np.rot90(image).copy(), BOARD)  # (u, v) -> (v, W - u)
    assert np.abs(np.stack([found[:, 1], 320 - found[:, 0]], 1) - quarter).max() < 0.2


def test_a_board_that_is_partly_covered_is_not_found():
    image = render_board(CAMERAS[4], BOARD, *board_pose(0.0))
    uv, _ = projected(CAMERAS[4], 0.0)
    covered = image.copy()
    covered[:, : int(uv[:, 0].min()) + 8] = WALL
    assert find_corners(covered, BOARD) is None
    assert find_corners(np.zeros((40, 60), np.float32), BOARD) is None


def test_keys_are_as_dense_as_the_board_is_fast():
    cameras, ticks = CAMERAS[::4], 4000
    spacing = key_spacing(cameras, BOARD, DISTANCE_M, ticks)
    assert 1 < spacing < 20
    at = [projected(c, s / ticks)[0] for c in cameras for s in range(0, ticks + spacing, spacing)]
    moved = np.linalg.norm(np.diff(np.reshape(at, (len(cameras), -1, 40, 2)), axis=1), axis=-1)
    assert 0.5 < moved.max() < 1.02
    assert key_spacing(cameras, BOARD, DISTANCE_M, 10**6) == 20 and key_spacing(cameras, BOARD, DISTANCE_M, 20) == 1
