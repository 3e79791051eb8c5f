"""The initial estimate for the bundle adjustment: every camera alone, then chained by the views that cameras share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.generators.recorder.rig_calibration.bundle_adjustment import Detections, Rig

FEWEST_VIEWS = 4  # of the board for each camera: three tilts determine a focal length, one is to spare


def estimate_rig(
    detections: Detections, points: Float64, names: Sequence[str], size: tuple[int, int]
) -> tuple[Rig, int]:
    """Return a rig near the solution, and its reference camera (the one with most views). `size`: width, height.

    Every view has a detection. Zhang's method gives each camera its focal length and the board in its frame; the
    principal point is the middle of the image. Cameras are then joined to the reference by shared views: of the
    relative poses that single views suggest, the one that fits all of them best is used (a flat board far away
    sometimes has a false twin).
    Raises UserError where a camera has too few views, or shares none with the others.
    """
    by_camera = [detections.of(detections.camera == c) for c in range(len(names))]
    for name, mine in zip(names, by_camera, strict=True):
        if len(mine.view) < FEWEST_VIEWS:
            fix = "show it the whole board, longer or in better light, check --columns and --rows, or raise --views"
            raise problem(f"camera {name}", f"the board in {FEWEST_VIEWS} views", f"{len(mine.view)}", fix)
    alone = [_alone(mine, points, size) for mine in by_camera]
    n, n_views = len(names), int(detections.view.max()) + 1
    principal = np.tile(np.array(size) / 2, (n, 1))
    reference = int(np.argmax([len(mine.view) for mine in by_camera]))
    identity = np.tile(np.eye(4), (n_views, 1, 1))
    rig = Rig(np.array([f for f, _ in alone]), principal, *_parts(np.tile(np.eye(4), (n, 1, 1))), *_parts(identity))
    boards = [poses for _, poses in alone]
    cameras = _chained(rig, boards, by_camera, points, names, reference)
    rig = replace(rig, **dict(zip(("R", "t"), _parts(np.stack(cameras)), strict=True)))
    board_poses = [
        _board_pose(rig, v, boards, cameras, detections.of(detections.view == v), points) for v in range(n_views)
    ]
    return replace(rig, **dict(zip(("board_R", "board_t"), _parts(np.stack(board_poses)), strict=True))), reference


def _alone(mine: Detections, points: Float64, size: tuple[int, int]) -> tuple[float, dict[int, Float64]]:
    """Return the focal length of a camera, and the board in its frame [4, 4] by view."""
    import cv2

    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    on_board = [points.astype(np.float32)] * len(mine.view)
    pixels = list((mine.uv - 0.5).astype(np.float32))  # OpenCV counts from pixel centres
    _, K, _, turns, shifts = cv2.calibrateCamera(on_board, pixels, size, np.eye(3), np.zeros(5), flags=flags)
    poses = {}
    for view, turn, shift in zip(mine.view, turns, shifts, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        poses[int(view)] = pose
    return float(K[0, 0]), poses


def _chained(
    rig: Rig,
    boards: list[dict[int, Float64]],
    by_camera: list[Detections],
    points: Float64,
    names: Sequence[str],
    reference: int,
) -> list[Float64]:
    """Return world to camera [4, 4] of every camera; the world is the reference camera's frame."""
    poses = {reference: np.eye(4)}
    while len(poses) < len(boards):
        left = [b for b in range(len(boards)) if b not in poses]
        shared, a, b = max((len(boards[a].keys() & boards[b].keys()), a, b) for a in poses for b in left)
        if not shared:
            found = f"{', '.join(names[c] for c in left)} without"
            fix = "show the board to two cameras at once"
            raise problem("board", "views that each camera shares with another", found, fix)
        common = sorted(boards[a].keys() & boards[b].keys())
        both = by_camera[b].of(np.isin(by_camera[b].view, common))
        suggested = [boards[b][v] @ np.linalg.inv(boards[a][v]) for v in common]
        misfits = [
            np.median(_errors(rig, both, points, np.stack([pose @ boards[a][int(v)] for v in both.view])))
            for pose in suggested
        ]
        poses[b] = suggested[int(np.argmin(misfits))] @ poses[a]
    return [poses[c] for c in range(len(boards))]


def _board_pose(
    rig: Rig, view: int, boards: list[dict[int, Float64]], cameras: list[Float64], mine: Detections, points: Float64
) -> Float64:
    """Return board to world [4, 4]: of the poses from each camera that sees it, the one that fits all of them best."""
    suggested = [np.linalg.inv(cameras[c]) @ boards[c][view] for c in mine.camera]
    misfits = [
        np.sum(np.median(_errors(rig, mine, points, np.stack([cameras[c] @ pose for c in mine.camera])), axis=1))
        for pose in suggested
    ]
    return suggested[int(np.argmin(misfits))]


def _errors(rig: Rig, s: Detections, points: Float64, board_to_camera: Float64) -> Float64:
    """Return the distances in px [S, N] between the corners and their projections by these poses [S, 4, 4]."""
    x = points @ board_to_camera[:, :3, :3].transpose(0, 2, 1) + board_to_camera[:, None, :3, 3]
    uv = rig.focal[s.camera][:, None, None] * x[..., :2] / x[..., 2:] + rig.principal[s.camera][:, None]
    return np.asarray(np.linalg.norm(uv - s.uv, axis=-1))


def _parts(poses: Float64) -> tuple[Float64, Float64]:
    """Return rotations [n, 3, 3] and translations [n, 3] of poses [n, 4, 4]."""
    return poses[:, :3, :3], poses[:, :3, 3]
