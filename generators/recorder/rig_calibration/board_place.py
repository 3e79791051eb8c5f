"""Where a board moves in front of an array: at a distance and of a size at which every camera sees all of it.

The nearest place is that of the nine cameras of `array`, by the field of view alone. Cameras that stand far apart, as
those of a street, share no view there: the board goes farther away, and grows with the distance so that its image stays
as large.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.metrics.pose_error import Sim3
from spike4dgs.benchmark.scene.cameras import Camera, array_axes
from spike4dgs.generators.recorder.rig_calibration.board import Board
from spike4dgs.generators.recorder.rig_calibration.board_clip import DISTANCE_M, FIELD_DEG, board_pose

SQUARE_M = 0.04  # of the board at the nearest place
LEAST_SEEN = 0.7  # share of the clip in which each camera sees the whole board
_INSTANTS = 101  # of the motion that are looked at
_STEP, _FARTHEST = 1.1, 300.0  # of the distances that are tried, as multiples of the nearest
_SHARES = (1.0, 0.8, 0.6, 0.4)  # sizes that are tried, of the one with the usual image
_MOST_SLANT_DEG = 75.0  # between the board's normal and the line to a camera
_LEAST_PX = 4.0  # of a given square: a smaller one is not found


@dataclass(frozen=True, eq=False)
class Place:
    """An array in the frame of its board, the board, and the share of the clip in which each camera sees all of it."""

    cameras: tuple[Camera, ...]
    board: Board
    distance_m: float
    seen: Mapping[str, float]

    @property
    def square_px(self) -> float:
        """Side of a square in the image of the camera in which it is smallest."""
        return self.board.square_m * min(c.fx for c in self.cameras) / self.distance_m


def place_board(
    cameras: Sequence[Camera], columns: int, rows: int, square_m: float | None = None, distance_m: float | None = None
) -> Place:
    """Return the nearest place where every camera sees the board, of the given square or else of one that fits.

    With a `distance_m` the cameras are in the board's frame already, that far from its middle, and stay there. Raises
    UserError where there is no such place.
    """
    nearest = _nearest(cameras) if distance_m is None else distance_m
    farther = 0 if distance_m is not None else round(math.log(_FARTHEST, _STEP))
    distances = [nearest * _STEP**k for k in range(farther + 1)]

    def at(distance: float, square: float) -> Place:
        placed = _in_front(cameras, distance) if distance_m is None else tuple(cameras)
        board = Board(columns, rows, square)
        return Place(placed, board, distance, _seen(placed, board, distance))

    def fitting() -> Place | None:
        return _first_good(at(d, _rounded(SQUARE_M * share * d / nearest)) for share in _SHARES for d in distances)

    if square_m is not None:
        given = _first_good(at(d, square_m) for d in distances)
        if given and (given.square_px >= _LEAST_PX or given.distance_m == nearest):
            return given
        where = f"{columns} x {rows} board of {square_m:g} m squares"
        raise _misplaced(where, given or at(nearest, square_m), fitting())
    if found := fitting():
        return found
    raise _misplaced(f"{columns} x {rows} board", at(nearest, SQUARE_M), None)


def _misplaced(where: str, tried: Place, other: Place | None) -> UserError:
    """Return the error for a board that has no place, with the cameras that miss it at the place that was tried."""
    missing = [camera for camera, share in tried.seen.items() if share < LEAST_SEEN]
    found = f"{', '.join(missing)} without it at {tried.distance_m:.3g} m"
    if not missing:
        found = f"squares of {tried.square_px:.1f} px at {tried.distance_m:.3g} m, the nearest place"
    fix = "calibrate groups of cameras that share a view"
    if other:
        fix = f"take squares of {other.board.square_m:g} m, or leave --square-m out"
    return problem(where, "a place where every camera sees all of it", found, fix)


def _first_good(places: Iterable[Place]) -> Place | None:
    return next((p for p in places if min(p.seen.values()) >= LEAST_SEEN), None)


def _nearest(cameras: Sequence[Camera]) -> float:
    """Return the distance at which the widest camera sees a board as those of `array` do."""
    half_field = max(c.width / (2 * c.fx) for c in cameras)
    return DISTANCE_M * math.tan(math.radians(FIELD_DEG) / 2) / half_field


def _in_front(cameras: Sequence[Camera], distance_m: float) -> tuple[Camera, ...]:
    """Return the cameras of any array in the board's frame, whose origin is that far in front of the array's middle.

    Camera-to-camera poses are the array's own.
    """
    W, centers = array_axes(cameras), np.stack([c.center for c in cameras])
    frame = Sim3(1.0, W, -W @ centers.mean(axis=0) - [0.0, distance_m, 0.0])
    return tuple(map(frame.camera, cameras))


def _seen(cameras: Sequence[Camera], board: Board, distance_m: float) -> dict[str, float]:
    """Return the share of the motion in which each camera sees all corners and half a square around, from the front."""
    half = np.array([board.columns, board.rows]) / 2 * board.square_m
    outline = np.array([[x, y, 0.0] for x in (-half[0], half[0]) for y in (-half[1], half[1])])
    poses = [board_pose(s, distance_m) for s in np.linspace(0, 1, _INSTANTS)]
    corners = np.stack([outline @ R.T + t for R, t in poses])  # [n, 4, 3]
    normals, middles = np.stack([-R[:, 2] for R, _ in poses]), np.stack([t for _, t in poses])  # towards the cameras
    seen = {}
    for c in cameras:
        uv, depth = c.project(corners.reshape(-1, 3))
        inside = (depth > 0) & (uv > 0).all(axis=1) & (uv < [c.width, c.height]).all(axis=1)
        line = c.center - middles
        facing = (line * normals).sum(axis=1) / np.linalg.norm(line, axis=1)
        front = facing > math.cos(math.radians(_MOST_SLANT_DEG))
        seen[c.id] = float(np.mean(inside.reshape(-1, 4).all(axis=1) & front))
    return seen


def _rounded(metres: float) -> float:
    """Return a length of two digits, which people can type."""
    return float(f"{metres:.2g}")
