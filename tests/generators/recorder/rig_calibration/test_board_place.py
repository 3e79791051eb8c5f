"""Every camera of any array sees the board, or one line says why none can be placed."""

from __future__ import annotations

import numpy as np
import pytest
from built_worlds import built

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import look_at
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.cli import main
from spike4dgs.generators.recorder.rig_calibration.board_clip import DISTANCE_M, array, board_pose
from spike4dgs.generators.recorder.rig_calibration.board_place import LEAST_SEEN, place_board
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import OURS

UP = np.array([0.0, 0.0, 1.0])


def rig_of(world, width=400, height=250):
    return cameras(built(world), width, height)


def visible(place, n=60):
    """Return the share of the motion in which each camera has all inner corners in its image."""
    shares = []
    for c in place.cameras:
        inside = 0
        for s in np.linspace(0, 1, n):
            R, t = board_pose(s, place.distance_m)
            uv, z = c.project(place.board.corners @ R.T + t)
            inside += bool((z > 0).all() and (uv > 0).all() and (uv < [c.width, c.height]).all())
        shares.append(inside / n)
    return shares


@pytest.mark.parametrize("world", OURS)
def test_every_camera_of_every_world_sees_the_board(world):
    place = place_board(rig_of(world), 8, 5)
    assert min(visible(place)) >= LEAST_SEEN and min(place.seen.values()) >= LEAST_SEEN
    assert place.square_px > 15
    for a, b, given in zip(place.cameras, place.cameras[1:], rig_of(world), strict=False):
        assert a.id == given.id and np.linalg.norm(a.center - b.center) > 0.01


@pytest.mark.parametrize("world", ["bricks", "chips", "turntable", "bird"])
def test_arrays_of_a_desk_have_the_usual_board(world):
    place = place_board(rig_of(world), 8, 5)
    half_field = max(c.width / (2 * c.fx) for c in place.cameras)
    assert place.board.square_m == 0.04
    assert place.distance_m == pytest.approx(DISTANCE_M * np.tan(np.radians(17)) / half_field)


@pytest.mark.parametrize("seed", range(5))
def test_our_own_array_stays_where_it_is(seed):
    own = array(400, 250, seed)
    place = place_board(own, 8, 5, None, DISTANCE_M)
    assert place.cameras == own and (place.board.square_m, place.distance_m) == (0.04, DISTANCE_M)


def test_a_given_square_has_its_own_distance():
    place = place_board(rig_of("car"), 8, 5, 0.1)
    assert place.board.square_m == 0.1 and min(visible(place)) >= LEAST_SEEN
    assert place.distance_m < place_board(rig_of("car"), 8, 5).distance_m


def test_a_square_that_fits_nowhere_is_refused_with_one_that_does(tmp_path, capsys):
    assert main(["board-clip", "--out", str(tmp_path / "b"), "--seconds", "0.001", "--square-m", "0.2"]) == 2
    error = capsys.readouterr().err
    assert "without it at 1 m; take squares of 0.04 m" in error and error.count("\n") == 1
    assert not (tmp_path / "b").exists()
    with pytest.raises(UserError, match=r"squares of 2\.\d px at .* m, the nearest place; take squares of 0\.\d+ m"):
        place_board(rig_of("car"), 8, 5, 0.01)


def test_cameras_that_share_no_view_are_refused():
    apart = [
        look_at(f"cam_{i}", np.zeros(3), np.array([np.sin(a), np.cos(a), 0]), UP, focal=400, width=400, height=250)
        for i, a in enumerate(np.radians([-40, 0, 40]))
    ]
    with pytest.raises(UserError, match="cam_0, cam_2 without it .*; calibrate groups of cameras that share a view"):
        place_board(apart, 8, 5)


def test_the_command_says_what_to_calibrate_with(small_scene, tmp_path, capsys):
    out = tmp_path / "b"
    assert main(["board-clip", "--out", str(out), "--seconds", "0.001", "--like", str(small_scene)]) == 0
    printed = capsys.readouterr().out
    square = open_scene(out).meta["source"]["square_m"]
    assert f"calibrate-rig needs --columns 8 --rows 5 --square-m {square:g}" in printed
