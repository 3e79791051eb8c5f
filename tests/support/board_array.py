"""A small array of simulated cameras and a moving board, for the tests of the rig calibration."""

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
