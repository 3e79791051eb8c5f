"""Every camera of any array sees the board, or one line says why none can be placed.

`worlds/test_worlds.py` places it before the arrays of all worlds.
"""

from __future__ import annotations

import numpy as np
import pytest
from board_array import visible
from built_worlds import built

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import look_at
from spike4dgs.cli import main
from spike4dgs.generators.recorder.rig_calibration.board_clip import DISTANCE_M, array
from spike4dgs.generators.recorder.rig_calibration.board_place import LEAST_SEEN, place_board
from spike4dgs.generators.rig import cameras

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def street():
    return cameras(built("car"), 400, 250)


@pytest.mark.parametrize("seed", range(5))
def test_our_own_array_stays_where_it_is(seed):
    own = array(400, 250, seed)
    place = place_board(own, 8, 5, None, DISTANCE_M)
    assert place.cameras == own and (place.board.square_m, place.distance_m) == (0.04, DISTANCE_M)


def test_a_given_square_has_its_own_distance(street):
    place = place_board(street, 8, 5, 0.1)
    assert place.board.square_m == 0.1 and min(visible(place)) >= LEAST_SEEN
    assert place.distance_m < place_board(street, 8, 5).distance_m


def test_a_square_that_fits_nowhere_is_refused_with_one_that_does(street, tmp_path, capsys):
    assert main(["board-clip", "--out", str(tmp_path / "b"), "--seconds", "0.001", "--square-m", "0.2"]) == 2
    error = capsys.readouterr().err
    assert "without it at 1 m; take squares of 0.04 m" in error and error.count("\n") == 1
    assert not (tmp_path / "b").exists()
    with pytest.raises(UserError, match=r"squares of 2\.\d px at .* m, the nearest place; take squares of 0\.\d+ m"):
        place_board(street, 8, 5, 0.01)


def test_cameras_that_share_no_view_are_refused():
    apart = [
        look_at(f"cam_{i}", np.zeros(3), np.array([np.sin(a), np.cos(a), 0]), UP, focal=400, width=400, height=250)
        for i, a in enumerate(np.radians([-40, 0, 40]))
    ]
    with pytest.raises(UserError, match="cam_0, cam_2 without it .*; calibrate groups of cameras that share a view"):
        place_board(apart, 8, 5)
