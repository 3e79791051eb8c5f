"""Cameras of OpenCV's FileStorage, YAML or XML.

One file holds one camera, named like the file, or a map for each camera, named like its stream:

    camera_matrix, distortion_coefficients (optional), R (3x3, or a rotation vector), T, image_width, image_height

with x_cam = R x_world + T, as from `calibrateCamera`, `solvePnP` and `stereoCalibrate`. Size is optional. Keys of
other programs are known too: `K` or `cameraMatrix`, `D` or `distCoeffs`, `rvec`, `t` or `tvec`. The coefficients are a
fisheye's where `fisheye_model` (OpenCV's calibration sample) or `distortion_model` (ROS) says so.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.exchange.foreign_camera import (
    CENTRE,
    FoundCamera,
    check_size,
    fisheye_distortion,
    make_camera,
    with_brown_lens,
)
from spike4dgs.benchmark.files import read_text
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.untrusted import parse_yaml, shown, whole

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

Values = dict[str, Any]
SUFFIXES = (".yml", ".yaml", ".xml")
_MATRIX = ("camera_matrix", "cameraMatrix", "K")
_DISTORTION = ("distortion_coefficients", "distCoeffs", "D")
_ROTATION = ("R", "rvec")
_TRANSLATION = ("T", "t", "tvec")
_WHAT = "cameras written by OpenCV's FileStorage"
_MOST_BYTES = 1 << 18  # a camera takes one kB
_MATRIX_TAGS = tuple(f"tag:yaml.org,2002:opencv-{kind}" for kind in ("matrix", "nd-matrix"))
_TYPES = ("d", "f", "i", "u", "w", "s", "c")  # of matrices of one channel
_MOST_VALUES = 100  # of a matrix of a camera
_DEPTH = 16  # of maps and lists in XML
_COEFFICIENTS = (4, 5, 8, 12, 14)  # that OpenCV's lens model takes
_NO_FISHEYE = (None, 0, "0")  # values of `fisheye_model`
_FISHEYES = ("equidistant", "fisheye")  # values of `distortion_model`
_BROWN = ("plumb_bob", "radtan", "rational_polynomial")  # others, of OpenCV's lens model
_EXACT = 1e-9  # of the entries of a camera matrix that are 0 or 1


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
    try:
        root = _values(read_text(path, _WHAT, _MOST_BYTES), path.suffix == ".xml")
    except ValueError as e:
        raise problem(path, _WHAT, f"damaged text ({str(e)[:200]})", "write it again") from None
    nodes = {path.stem: root} if _get(root, _MATRIX) is not None else {}
    nodes = nodes or {str(name): node for name, node in root.items() if isinstance(node, dict) and "dt" not in node}
    if not nodes:
        raise problem(path, f"{_MATRIX[0]}, or a map with it for each camera", "none", "write it again")
    return {name: _camera(name, node, size, path) for name, node in nodes.items()}


def _values(text: str, xml: bool) -> Values:
    """Return the values of a file: numbers, texts, lists and maps; a matrix is a map of its size, dt and data.

    OpenCV's own parser writes beyond its memory for matrices that contradict themselves. Raises ValueError for bad
    syntax.
    """
    if xml:
        return _xml_values(text)
    first, _, rest = text.partition("\n")
    found = parse_yaml(rest if first.startswith("%YAML") else text, _MATRIX_TAGS)
    if not isinstance(found, dict):
        raise ValueError("no map")
    return found


def _xml_values(text: str) -> Values:
    from xml.etree import ElementTree

    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("a document type")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as e:
        raise ValueError(str(e)) from None
    return {child.tag: _xml_value(child, _DEPTH) for child in root}


def _xml_value(node: Element, depth: int) -> Any:
    if depth == 0:
        raise ValueError("values nested too deep")
    if not len(node):
        words = (node.text or "").split()
        return words[0] if len(words) == 1 and node.tag != "data" else words
    if all(child.tag == "_" for child in node):
        return [_xml_value(child, depth - 1) for child in node]
    return {child.tag: _xml_value(child, depth - 1) for child in node}


def _get(node: Values, keys: tuple[str, ...]) -> Any:
    """Return the first value that is there, or None."""
    return next((node[key] for key in keys if node.get(key) is not None), None)


def _matrix(node: Values, keys: tuple[str, ...], name: str, path: Path) -> Float64:
    """Return a matrix, or a list of numbers, as float64."""
    found = _get(node, keys)
    if found is None:
        fix = "add it; the camera at the world's origin has R = 1 and T = 0"
        raise problem(path, f"{' or '.join(keys)} of {name}", "none", fix)
    try:
        if not isinstance(found, dict):
            return np.array([float(value) for value in found], np.float64)
        sizes = found["sizes"] if "sizes" in found else [found["rows"], found["cols"]]
        shape = tuple(whole(float(n), 1, _MOST_VALUES) for n in (sizes if isinstance(sizes, list) else [sizes]))
        values = np.array([float(value) for value in found["data"]], np.float64)
        kind = found.get("dt", "d")  # ROS leaves it out
        if kind not in _TYPES or math.prod(shape) != len(values) or len(values) > _MOST_VALUES:
            raise ValueError(f"{len(values)} values of shape {shape}, type {shown(kind)}")
        return values.reshape(shape)
    except (KeyError, TypeError, ValueError, OverflowError) as e:
        raise problem(path, f"a matrix {keys[0]} of {name}", str(e)[:200], "write it again") from None


def _side(node: Values, name: str, path: Path) -> int | None:
    value = node.get(name)
    try:
        return None if value is None else int(float(value))
    except (TypeError, ValueError, OverflowError):
        raise problem(path, f"a number as {name}", shown(value), "write it again") from None


def _camera(name: str, node: Values, size: tuple[int, int], path: Path) -> FoundCamera:
    import cv2

    K, R, t = (_matrix(node, keys, name, path) for keys in (_MATRIX, _ROTATION, _TRANSLATION))
    if K.shape != (3, 3) or not _is_plain(K) or R.size not in (3, 9):
        found = f"{shown(K.tolist())} and {R.size} values"
        expected = f"a 3x3 matrix (fx, 0, cx; 0, fy, cy; 0, 0, 1) and 9 or 3 values of R for {name}"
        raise problem(path, expected, found, "calibrate again")
    width, height = (_side(node, f"image_{key}", path) for key in ("width", "height"))
    if width is not None and height is not None:
        check_size((width, height), size, name, path)
    intrinsics = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    rotation = cv2.Rodrigues(R.reshape(3))[0] if R.size == 3 else R
    return _with_lens(make_camera(name, size, intrinsics, rotation, t, path, CENTRE), node, path)


def _is_plain(K: Float64) -> bool:
    """Return whether a camera matrix [3, 3] has no skew and is neither transposed nor scaled."""
    fixed = np.array([K[0, 1], K[1, 0], K[2, 0], K[2, 1], K[2, 2] - 1])
    return bool((np.abs(fixed) <= _EXACT).all())


def _with_lens(camera: Camera, node: Values, path: Path) -> FoundCamera:
    if (model := node.get("distortion_model")) not in (None, *_BROWN, *_FISHEYES):
        expected = f"a distortion_model of {camera.id} among {', '.join((*_BROWN, *_FISHEYES))}, or none"
        raise problem(path, expected, shown(model), "calibrate with one of them")
    fisheye = node.get("fisheye_model") not in _NO_FISHEYE or model in _FISHEYES
    if _get(node, _DISTORTION) is None:
        return FoundCamera(camera, fisheye_distortion(np.zeros(4)) if fisheye else None)
    coefficients = _matrix(node, _DISTORTION, camera.id, path).ravel()
    counts = (4,) if fisheye else _COEFFICIENTS
    if len(coefficients) not in counts:
        expected = f"{', '.join(map(str, counts))} {_DISTORTION[0]} of {camera.id}"
        raise problem(path, expected, str(len(coefficients)), "write OpenCV's own")
    if not np.isfinite(coefficients).all():
        raise problem(path, f"finite {_DISTORTION[0]} of {camera.id}", "others", "calibrate again")
    if fisheye:
        return FoundCamera(camera, fisheye_distortion(coefficients))
    return with_brown_lens(camera, coefficients)
