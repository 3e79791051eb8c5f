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
    poses = [board_pose(s, place.distance_m) for s in np.linspace(0, 1, n)]
    corners = np.concatenate([place.board.corners @ R.T + t for R, t in poses])
    shares = []
    for c in place.cameras:
        uv, z = c.project(corners)
        inside = (z > 0) & (uv > 0).all(1) & (uv < [c.width, c.height]).all(1)
        shares.append(float(inside.reshape(n, -1).all(1).mean()))
    return shares
