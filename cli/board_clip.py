"""`board-clip`: a scene of a chessboard that moves in front of an array, to try recording and calibration."""

from __future__ import annotations

from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.untrusted import MAX_SIDE
from spike4dgs.generators.profiles import RATE_HZ
from spike4dgs.generators.recorder.rig_calibration.board_clip import DISTANCE_M, array, write_board_clip
from spike4dgs.generators.recorder.rig_calibration.board_place import place_board

_MOST_SECONDS = 3600


def board_clip(
    *,
    out: Path = Path("runs/board"),
    seconds: float = 1.0,
    width: int = 400,
    height: int = 250,
    columns: int = 8,
    rows: int = 5,
    square_m: float | None = None,
    seed: int = 0,
    like: Path | None = None,
) -> int:
    """Simulate a chessboard that moves in front of an array of cameras: a scene for `record --emulate`.

    The board is placed where every camera sees all of it for most of the clip. If the cameras are far apart, it is
    farther away and larger. Its size is printed, for `calibrate-rig --square-m`.

    Args:
        out: Folder of the scene.
        seconds: Length of the clip. The board makes the same motion in any length, so it is slower in a longer clip.
        width: Pixels per row of the cameras.
        height: Rows of the cameras.
        columns: Inner corners of the board from left to right.
        rows: Inner corners from top to bottom; one of the two numbers must be odd, the other even.
        square_m: Side of a square in metres; if left out, 0.04, or another size that every camera sees whole.
        seed: Seed of the array's mounting errors and of the sensors.
        like: A scene folder whose array films the board, instead of nine cameras of --width and --height.
    """
    if not 0.5 < seconds * RATE_HZ <= _MOST_SECONDS * RATE_HZ:
        expected = f"from {1 / RATE_HZ:g}, one tick, to {_MOST_SECONDS}"
        raise problem("--seconds", expected, f"{seconds:g}", "ask for another length")
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        found = f"{width}, {height}"
        raise problem("--width and --height", f"whole numbers from 1 to {MAX_SIDE}", found, "correct them")
    n_ticks = round(seconds * RATE_HZ)
    if like is None:
        place = place_board(array(width, height, seed), columns, rows, square_m, DISTANCE_M)
    else:
        place = place_board(tuple(open_scene(like, allow_gaps=True).cameras.values()), columns, rows, square_m)
    path = write_board_clip(out, place.cameras, place.board, place.distance_m, n_ticks, seed)
    print(f"{path}: {n_ticks} ticks of {len(place.cameras)} cameras")
    print(
        f"board of {columns} x {rows} corners at {place.distance_m:.2f} m; each camera sees all of it for "
        f"{min(place.seen.values()):.0%} of the clip or more"
    )
    print(f"calibrate-rig needs --columns {columns} --rows {rows} --square-m {place.board.square_m:g}")
    return 0
