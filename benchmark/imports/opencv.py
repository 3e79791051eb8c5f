"""Cameras of OpenCV's FileStorage, YAML or XML.

One file holds one camera, named like the file, or a map for each camera, named like its stream:

    camera_matrix, distortion_coefficients (optional), R (3x3, or a rotation vector), T, image_width, image_height

with x_cam = R x_world + T, as from `calibrateCamera`, `solvePnP` and `stereoCalibrate`. Size is optional. Keys of
other programs are known too: `K` or `cameraMatrix`, `D` or `distCoeffs`, `rvec`, `t` or `tvec`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.imports.found_camera import (
    CENTRE,
    Float64,
    FoundCamera,
    check_size,
    make_camera,
    with_brown_lens,
)

SUFFIXES = (".yml", ".yaml", ".xml")
_MATRIX = ("camera_matrix", "cameraMatrix", "K")
_DISTORTION = ("distortion_coefficients", "distCoeffs", "D")
_ROTATION = ("R", "rvec")
_TRANSLATION = ("T", "t", "tvec")
_COEFFICIENTS = (4, 5, 8, 12, 14)  # that OpenCV's lens model takes


def read_opencv_files(paths: list[Path], size: tuple[int, int]) -> dict[str, FoundCamera]:
    """Return the cameras of files by name. Raises UserError where one is damaged or lacks a value."""
    found: dict[str, FoundCamera] = {}
    for path in paths:
        for name, camera in _read(path, size).items():
            if name in found:
                raise problem(path, "cameras of different names", f"{name} twice", "rename one")
            found[name] = camera
    return found


def _read(path: Path, size: tuple[int, int]) -> dict[str, FoundCamera]:
    import cv2

    try:
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        root = file.root()
        nodes = {path.stem: root} if _get(root, _MATRIX) is not None else {}
        nodes = nodes or {name: node for name in root.keys() if (node := root.getNode(name)).isMap()}
        cameras = {name: _camera(name, node, size, path) for name, node in nodes.items()}
    except (cv2.error, SystemError) as e:
        found = f"damaged text ({e})"
        raise problem(path, "cameras written by OpenCV's FileStorage", found, "write it again") from None
    if not cameras:
        raise problem(path, f"{_MATRIX[0]}, or a map with it for each camera", "none", "write it again")
    return cameras


def _get(node: Any, keys: tuple[str, ...]) -> Any:
    """Return the first node that is there, or None."""
    return next((n for key in keys if not (n := node.getNode(key)).empty()), None)


def _matrix(node: Any, keys: tuple[str, ...], name: str, path: Path) -> Float64:
    """Return a matrix, or a list of numbers, as float64."""
    found = _get(node, keys)
    if found is None:
        fix = "add it; the camera at the world's origin has R = 1 and T = 0"
        raise problem(path, f"{' or '.join(keys)} of {name}", "none", fix)
    matrix = [found.at(i).real() for i in range(found.size())] if found.isSeq() else found.mat()
    if matrix is None:
        raise problem(path, f"a matrix {keys[0]} of {name}", "something else", "write it again")
    return np.asarray(matrix, np.float64)


def _camera(name: str, node: Any, size: tuple[int, int], path: Path) -> FoundCamera:
    import cv2

    K, R, t = (_matrix(node, keys, name, path) for keys in (_MATRIX, _ROTATION, _TRANSLATION))
    if K.shape != (3, 3) or abs(K[0, 1]) > 1e-9 or R.size not in (3, 9):
        found = f"{K.tolist()} and {R.size} values"
        raise problem(path, f"a 3x3 matrix without skew and 9 or 3 values of R for {name}", found, "calibrate again")
    width, height = (node.getNode(f"image_{key}") for key in ("width", "height"))
    if not (width.empty() or height.empty()):
        check_size((int(width.real()), int(height.real())), size, name, path)
    intrinsics = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    rotation = cv2.Rodrigues(R.reshape(3))[0] if R.size == 3 else R
    camera = make_camera(name, size, intrinsics, rotation, t, path, CENTRE)
    if _get(node, _DISTORTION) is None:
        return FoundCamera(camera)
    coefficients = _matrix(node, _DISTORTION, name, path).ravel()
    if len(coefficients) not in _COEFFICIENTS:
        expected = f"{', '.join(map(str, _COEFFICIENTS))} {_DISTORTION[0]} of {name}"
        raise problem(path, expected, str(len(coefficients)), "write OpenCV's own")
    return with_brown_lens(camera, coefficients)
