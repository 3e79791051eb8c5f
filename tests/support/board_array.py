"""A small array of simulated cameras and a moving board, for the tests of the rig calibration."""

import numpy as np

from spike4dgs.generators.recorder.rig_calibration.board import Board
from spike4dgs.generators.recorder.rig_calibration.board_clip import array, board_pose

WIDTH, HEIGHT = 160, 100
BOARD = Board()
CAMERAS = array(WIDTH, HEIGHT)


def projected(camera, s, board=BOARD):
    """Return corners of the board in an image, and whether the image has all of them."""
    R, t = board_pose(s)
    uv, z = camera.project(board.corners @ R.T + t)
    assert (z > 0).all()
    return uv, bool(((uv > 3) & (uv < [camera.width - 3, camera.height - 3])).all())


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
