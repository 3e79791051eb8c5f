"""A simulated clip of a chessboard that moves in front of an array of nine spike cameras, to try the calibration.

The board's radiance is rendered with 4x4 samples a pixel, at key frames for every pixel that the board moves, and
passed to the sensor simulator of all scenes, with gain and dark maps and shot noise. The output is a scene folder, so
`record --emulate` serves it like a real array, and its poses are the truth for `calibrate-rig`. Not modelled: lenses
(the cameras are pinholes), and shading of the board by its tilt.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import check_new
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene, stream_name
from spike4dgs.benchmark.spikes.bits import in_threads, kernel
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.benchmark.spikes.stream import SpikeWriter
from spike4dgs.generators.profiles import RATE_HZ
from spike4dgs.generators.recorder.rig_calibration.board import Board
from spike4dgs.generators.rig import grid_camera
from spike4dgs.generators.sensor.calibration import noisy_sensor
from spike4dgs.generators.sensor.model import random_charge, simulate
from spike4dgs.generators.worlds import RigSpec
from spike4dgs.generators.worlds.meshes import rotation

LONGEST_KEY_TICKS, KEY_PX = 20, 1.0  # between two key frames: most ticks, and largest motion of the board
WHITE, DARK, WALL = 0.85, 0.04, 0.25  # radiance
_POSES = 500  # samples of the motion from which its speed is computed
DISTANCE_M, SPACING_M, FIELD_DEG = 1.0, 0.12, 34.0  # of the array; the field of view is the horizontal one
_PER_CAMERA_SPREAD = (0.02, 0.01, 1.0)  # standard deviations: focal length, principal point / width, degrees of turn


def board_pose(s: float, distance_m: float = DISTANCE_M) -> tuple[Float64, Float64]:
    """Return rotation [3, 3] and translation [3] from board to world (z up, viewing direction +y) at a share 0..1.

    The board sways, moves to and fro, tilts both ways and rolls. Every swing has its own number of cycles in a clip, so
    that position and tilt are uncorrelated, which separates focal lengths from distances.
    """

    def swing(amplitude: float, cycles: float, phase: float) -> float:
        return amplitude * math.sin(2 * math.pi * (cycles * s + phase))

    d = distance_m
    position = np.array([swing(0.10 * d, 2, 0.1), swing(0.15 * d, 1, 0.3), swing(0.05 * d, 3, 0.4)])
    tilt = _turn("x", swing(35, 2, 0.35)) @ _turn("y", swing(35, 3, 0.0)) @ _turn("z", swing(15, 1, 0.6))
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # the board's y is down, its z away
    return upright @ tilt, position


def _turn(axis: str, degrees: float) -> Float64:
    return rotation(axis, math.radians(degrees))[:3, :3]


def array(width: int, height: int, seed: int = 0, distance_m: float = DISTANCE_M) -> tuple[Camera, ...]:
    """Return nine cameras, 3x3, that look at the origin, each with its own errors of mounting and manufacture.

    Standard deviations: 2 % of the focal length, 1 % of the width in the principal point, a degree about each axis.
    """
    rng = np.random.default_rng([seed, *b"array"])
    rig = RigSpec((0.0, -distance_m, 0.0), (0.0, 0.0, 0.0), (SPACING_M, SPACING_M), toe_in=1.0, fov_x_deg=FIELD_DEG)
    f_spread, c_spread, turn_deg = _PER_CAMERA_SPREAD
    cameras = []
    for view in range(9):
        c = grid_camera(rig, view, width, height)
        f = c.fx * (1 + f_spread * rng.normal())
        cx, cy = np.array([c.cx, c.cy]) + c_spread * width * rng.normal(size=2)
        x, y, z = (_turn(axis, turn_deg * rng.normal()) for axis in "xyz")
        R = x @ y @ z @ c.R
        cameras.append(Camera(c.id, width, height, f, f, float(cx), float(cy), R, -R @ c.center))
    return tuple(cameras)


def render_board(camera: Camera, board: Board, R: Float64, t: Float64) -> Float32:
    """Return radiance [H, W] of the board in front of an even wall, with 4x4 samples a pixel. R, t: board to world.

    Raises UserError for a camera with lens distortion.
    """
    _check_pinhole(camera)
    to_camera = np.stack([camera.R @ R[:, 0], camera.R @ R[:, 1], camera.R @ t + camera.t], axis=1)
    to_board = np.linalg.inv(camera.K @ to_camera)  # (u, v, 1) -> (x, y, 1) / depth, x and y in the board's plane
    to_board[:2] /= board.square_m
    image = np.full((camera.height, camera.width), WALL, np.float32)
    top, bottom, left, right = _bounds(camera, board, R, t)
    part = image[top:bottom, left:right]
    in_threads(_render_rows, len(part), to_board, board.columns, board.rows, left, top, part, small=part.size < 20000)
    return image


def _check_pinhole(camera: Camera) -> None:
    if camera.distortion:
        raise problem(f"camera {camera.id}", "a pinhole", "lens distortion", "give --like a scene without it")


def _bounds(camera: Camera, board: Board, R: Float64, t: Float64) -> tuple[int, int, int, int]:
    """Return first and last row and column of the board with its margin; of the whole image where it is too near."""
    half = np.array([board.columns + 3, board.rows + 3]) / 2 * board.square_m
    outline = np.array([[x, y, 0.0] for x in (-half[0], half[0]) for y in (-half[1], half[1])])
    uv, depth = camera.project(outline @ R.T + t)
    if depth.min() <= 0:
        return 0, camera.height, 0, camera.width
    last = [camera.width, camera.height]
    left, top = np.clip(np.floor(uv.min(axis=0)).astype(int), 0, last)
    right, bottom = np.clip(np.ceil(uv.max(axis=0)).astype(int), 0, last)
    return int(top), int(bottom), int(left), int(right)


@kernel
def _render_rows(
    h: Float64, columns: int, rows: int, left: int, top: int, image: Float32, start: int, stop: int
) -> None:
    """Fill rows [start, stop) of a part of an image. h [3, 3]: pixel -> board in squares, over the depth."""
    for v in range(start, stop):
        for u in range(image.shape[1]):
            x, y = left + u, top + v
            light = _light(h, columns, rows, x, y)
            whole = True  # a pixel whose four corners are in one square sees only that square
            for k in range(1, 4):
                whole &= _square(h, columns, rows, x + k % 2, y + k // 2) == _square(h, columns, rows, x, y)
            if not whole:
                light = 0.0
                for k in range(16):
                    light += _light(h, columns, rows, x + (k % 4 + 0.5) / 4, y + (k // 4 + 0.5) / 4) / 16
            image[v, u] = light


@kernel
def _square(h: Float64, columns: int, rows: int, x: float, y: float) -> Any:
    """Return column and row of the board's square at a point of the image; the first square is (-1, -1)."""
    over = h[2, 0] * x + h[2, 1] * y + h[2, 2]
    a = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / over + (columns - 1) / 2
    b = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / over + (rows - 1) / 2
    return (math.floor(a), math.floor(b)) if over > 0 else (-9, -9)


@kernel
def _light(h: Float64, columns: int, rows: int, x: float, y: float) -> float:
    i, j = _square(h, columns, rows, x, y)
    if i < -2 or j < -2 or i > columns or j > rows:
        return WALL
    if i < -1 or j < -1 or i >= columns or j >= rows:
        return WHITE  # the margin, as wide as a square
    return DARK if (i + j) % 2 == 0 else WHITE


def write_board_clip(
    out: Path, cameras: tuple[Camera, ...], board: Board, distance_m: float, n_ticks: int, seed: int = 0
) -> Path:
    """Write the clip as a scene folder and return its path.

    Raises UserError where the folder exists, and for lens distortion.
    """
    for camera in cameras:
        _check_pinhole(camera)
    check_new(out)
    spacing = key_spacing(cameras, board, distance_m, n_ticks)
    key_ticks = list(range(0, n_ticks + spacing, spacing))
    poses = [board_pose(tick / n_ticks, distance_m) for tick in key_ticks]
    for camera in cameras:
        size, entropy = (camera.height, camera.width), [seed, *f"board {camera.id}".encode()]
        sensor = noisy_sensor(camera, seed, entropy)
        with SpikeWriter(out / stream_name(camera.id), camera.width, camera.height) as writer:
            keys = _Keys(camera, board, poses)
            for packed in simulate(keys, key_ticks, n_ticks, sensor, random_charge(*size, entropy)):
                writer.write(packed)
    ids = tuple(c.id for c in cameras)
    finish_scene(
        out,
        SceneDescription(
            id=f"board-{seed}",
            title="A chessboard that moves in front of the array",
            licence="CC0-1.0",
            cameras=cameras,
            train=ids,
            test=(),
            rate_hz=float(RATE_HZ),
            n_ticks=n_ticks,
            radiance_gain=SENSOR.radiance_gain,
            targets=(),
            sensor={"model": "integrate-and-fire/2", "rows_bottom_up": True},
            source={"kind": "board", **asdict(board), "seed": seed},
        ),
    )
    return out


def key_spacing(cameras: Sequence[Camera], board: Board, distance_m: float, n_ticks: int) -> int:
    """Return the ticks between key frames: no corner of the board moves by more than `KEY_PX` in any camera."""
    ticks = np.linspace(0, n_ticks, _POSES)
    corners = board.corners[[0, board.columns - 1, -board.columns, -1]]
    poses = [board_pose(tick / n_ticks, distance_m) for tick in ticks]
    world = np.concatenate([corners @ R.T + t for R, t in poses])
    tracks = np.stack([c.project(world)[0].reshape(_POSES, len(corners), 2) for c in cameras])
    fastest = float(np.linalg.norm(np.diff(tracks, axis=1), axis=-1).max()) / (ticks[1] - ticks[0])  # px a tick
    return int(np.clip(KEY_PX / fastest, 1, LONGEST_KEY_TICKS))


@dataclass(frozen=True, eq=False)
class _Keys(Sequence[Float32]):
    """A camera's images at the key ticks, rendered on access."""

    camera: Camera
    board: Board
    poses: list[tuple[Float64, Float64]]

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, k: Any) -> Any:
        return render_board(self.camera, self.board, *self.poses[k])
