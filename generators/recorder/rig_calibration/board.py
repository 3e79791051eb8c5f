"""A chessboard for calibration: its geometry, and its corners in an image.

Board coordinates, seen from the front: x to the right, y down, z into the board; the origin is its middle. Corners are
the inner ones, where four squares meet, row by row from the top left. The square below and right of the first corner is
dark. One of `columns` and `rows` is odd and the other even, so half a turn of the board exchanges dark and light, and
every image shows which way up the board is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.errors import problem

_MOST = 1000  # corners each way, and metres of a square
_FEWEST = 3  # corners in a row that the detector needs
_SMALL = 640  # px; a smaller image is enlarged by two for the detector


@dataclass(frozen=True)
class Board:
    """A chessboard of (columns + 1) x (rows + 1) squares. Raises UserError where half a turn would not change it.

    >>> Board(4, 3, 0.1).corners[:2].round(3).tolist()
    [[-0.15, -0.1, 0.0], [-0.05, -0.1, 0.0]]

    Attributes:
        columns: Inner corners of the board from left to right.
        rows: Inner corners from top to bottom. One of the two numbers must be odd, and the other even.
        square_m: Side of a square in metres, which sets the scale of the calibration.
    """

    columns: int = 8
    rows: int = 5
    square_m: float = 0.04

    def __post_init__(self) -> None:
        size = f"{self.columns} x {self.rows} inner corners of {self.square_m:g} m"
        if (
            min(self.columns, self.rows) < _FEWEST
            or max(self.columns, self.rows) > _MOST
            or not 0 < self.square_m <= _MOST
        ):
            raise problem(
                "chessboard", f"{_FEWEST} to {_MOST} inner corners each way and a size in metres", size, "correct them"
            )
        if (self.columns + self.rows) % 2 == 0:
            fix = "take a board that half a turn changes, such as 8 x 5"
            raise problem("chessboard", "one odd and one even number of inner corners", size, fix)

    @property
    def corners(self) -> Float64:
        """Inner corners [rows * columns, 3] in metres, row by row."""
        x = (np.arange(self.columns) - (self.columns - 1) / 2) * self.square_m
        y = (np.arange(self.rows) - (self.rows - 1) / 2) * self.square_m
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return np.concatenate([grid, np.zeros((len(grid), 1))], axis=1)


def find_corners(image: Float32, board: Board) -> Float64 | None:
    """Return the board's corners [rows * columns, 2] in px (pixel centres at +0.5); None if any corner is not visible.

    `image` is linear radiance [H, W], of any scale. OpenCV's sector-based detector (Duda and Frese, 2018) finds the
    grid. Its first corner and direction are then set to those of the board, by the handedness and by which squares are
    dark, so the order does not depend on how the board is held.
    """
    import cv2

    white = float(np.percentile(image, 99))
    if not white > 0:
        return None
    eight_bit = np.rint(np.clip(image / white, 0, 1) * 255).astype(np.uint8)
    zoom = 2 if max(eight_bit.shape) <= _SMALL else 1
    if zoom > 1:
        eight_bit = cv2.resize(eight_bit, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(eight_bit, (board.columns, board.rows), flags=flags)
    if not found or len(corners) != board.columns * board.rows:
        return None
    uv = (corners.reshape(board.rows, board.columns, 2).astype(np.float64) + 0.5) / zoom
    return _as_on_the_board(uv, image).reshape(-1, 2)


def _as_on_the_board(uv: Float64, image: Float32) -> Float64:
    """Return the grid [rows, columns, 2] in the board's order: not mirrored, dark below and right of corner 0."""
    right, down = uv[0, -1] - uv[0, 0], uv[-1, 0] - uv[0, 0]
    if right[0] * down[1] - right[1] * down[0] < 0:
        uv = uv[:, ::-1]
    middles = (uv[:-1, :-1] + uv[1:, :-1] + uv[:-1, 1:] + uv[1:, 1:]) / 4
    x, y = np.clip(middles.astype(int), 0, [image.shape[1] - 1, image.shape[0] - 1]).transpose(2, 0, 1)
    squares = image[y, x]
    dark = np.add.outer(np.arange(squares.shape[0]), np.arange(squares.shape[1])) % 2 == 0
    return uv if squares[dark].mean() < squares[~dark].mean() else uv[::-1, ::-1]
