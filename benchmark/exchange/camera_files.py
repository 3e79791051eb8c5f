"""Cameras of other programs' files, for streams: COLMAP, OpenCV or Kalibr, told apart by what is there."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.exchange.colmap import read_colmap_model
from spike4dgs.benchmark.exchange.foreign_camera import (
    CENTRE,
    FoundCamera,
    check_size,
    fisheye_distortion,
    make_camera,
    with_brown_lens,
)
from spike4dgs.benchmark.exchange.opencv import SUFFIXES, read_opencv_files
from spike4dgs.benchmark.scene.cameras import Camera, check_lens
from spike4dgs.benchmark.scene.lens import NAMES
from spike4dgs.benchmark.untrusted import read_yaml

_WHAT = "Kalibr's camera chain"
_KEYS = "camera_model, intrinsics, distortion_model, distortion_coeffs, resolution"
_DISTORTIONS = ("none", "radtan", "equidistant")


def is_camchain(path: Path) -> bool:
    """Return whether a YAML file looks like Kalibr's: a map of maps with `camera_model`."""
    try:
        chain = read_yaml(path, _WHAT)
    except UserError:  # OpenCV's first line, %YAML:1.0, is no YAML
        return False
    return isinstance(chain, dict) and any(isinstance(c, dict) and "camera_model" in c for c in chain.values())


def read_camchain(path: Path, size: tuple[int, int]) -> dict[str, FoundCamera]:
    """Return the cameras of a camera chain by name, `cam0` and so on; the world is the first one's.

    `T_cn_cnm1` takes coordinates of the camera before to this one's. Raises UserError where the file lacks a value or
    has another camera model than the pinhole.
    """
    chain: dict[Any, Any] = read_yaml(path, _WHAT)
    found, w2c = {}, np.eye(4)
    order = _chain_order(list(chain))
    for i, name in enumerate(order):
        entry = chain[name]
        try:
            model, intrinsics, resolution = entry["camera_model"], entry["intrinsics"], entry["resolution"]
            if i:
                w2c = np.asarray(entry["T_cn_cnm1"], np.float64).reshape(4, 4) @ w2c
            lens, coefficients = entry["distortion_model"], np.asarray(entry["distortion_coeffs"], np.float64)
        except (KeyError, TypeError, ValueError) as e:
            expected = f"{_KEYS} and, after {order[0]}, the first, a 4x4 T_cn_cnm1 of {name}"
            reason = f"no {e}" if isinstance(e, KeyError) else repr(e)
            fix = "put the cameras in the chain's order, or calibrate again"
            raise problem(path, expected, reason, fix) from None
        if model != "pinhole":
            raise problem(path, f"camera_model pinhole of {name}", repr(model), "calibrate with that model")
        check_size(tuple(resolution) if isinstance(resolution, list) else (resolution,), size, str(name), path)
        camera = make_camera(str(name), size, intrinsics, w2c[:3, :3], w2c[:3, 3], path, CENTRE)
        found[str(name)] = _with_distortion(camera, lens, coefficients, path)
    return found


def _chain_order(names: list[Any]) -> list[Any]:
    """Return names in the order of their chain: by number where all are one text and a number, else the file's.

    Writers of YAML put `cam10` before `cam2`; the names of renamed cameras say nothing of their order.
    """
    matched = ((re.fullmatch(r"(.*?)([0-9]{1,9})", str(name)), name) for name in names)
    numbered = [(match[1], int(match[2]), name) for match, name in matched if match]
    if len(numbered) < len(names) or len({prefix for prefix, *_ in numbered}) > 1:
        return names
    return [name for *_, name in sorted(numbered, key=lambda row: row[1])]


def _with_distortion(camera: Camera, lens: Any, coefficients: Any, path: Path) -> FoundCamera:
    name = camera.id
    if lens not in _DISTORTIONS:
        expected = f"a distortion_model of {name} among {', '.join(_DISTORTIONS)}"
        raise problem(path, expected, repr(lens), "calibrate with one of them")
    if lens == "none":
        return FoundCamera(camera)
    if coefficients.shape != (4,):
        raise problem(path, f"4 distortion_coeffs of {name}", str(coefficients.tolist()), "calibrate again")
    if lens == "radtan":
        return with_brown_lens(camera, coefficients)
    return FoundCamera(camera, fisheye_distortion(coefficients))


NEGLIGIBLE_PX = 0.05  # lens distortion below this is left out


def read_camera_files(path: Path, names: Sequence[str], size: tuple[int, int]) -> tuple[Camera, ...]:
    """Return a camera for each stream, by name; others are left out, which is said.

    Raises UserError where the file is missing, foreign or damaged, where a stream has no camera, and where a lens that
    is not OpenCV's k1, k2, p1, p2, k3 distorts by NEGLIGIBLE_PX or more.
    """
    found = _read(path, names, size)
    if missing := [name for name in names if name not in found]:
        known = ", ".join(sorted(found)) or "none"
        fix = "name the streams' files as the cameras are called"
        raise problem(path, "a camera for each stream", f"none for {', '.join(missing)} (it has {known})", fix)
    cameras = tuple(_with_lens(path, camera) for name in names if (camera := found[name]))
    if others := sorted(set(found) - set(names)):
        print(f"{path}: no stream of {', '.join(others)}: left out")
    return cameras


def _read(path: Path, names: Sequence[str], size: tuple[int, int]) -> Mapping[str, FoundCamera | None]:
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.suffix in SUFFIXES)
        return read_opencv_files(files, size) if files else read_colmap_model(path, names, size)
    if not path.is_file():
        raise problem(path, "a COLMAP model, or OpenCV's or Kalibr's cameras", "no such file", "check the path")
    if path.suffix not in SUFFIXES:
        expected = f"a COLMAP model's folder, or a file of OpenCV or Kalibr ({', '.join(SUFFIXES)})"
        raise problem(path, expected, path.suffix or "no suffix", "give such a file")
    if path.suffix != ".xml" and is_camchain(path):
        return read_camchain(path, size)
    return read_opencv_files([path], size)


def _with_lens(path: Path, found: FoundCamera) -> Camera:
    """Return the camera of a scene, with its lens where it distorts noticeably."""
    px, camera = found.distortion_px, found.camera
    if px < NEGLIGIBLE_PX:
        if px:
            print(f"{camera.id}: lens distortion of at most {px:.3f} px is left out")
        return replace(camera, distortion=())
    if found.distort:
        expected = f"OpenCV's lens model ({', '.join(NAMES)}), or distortion below {NEGLIGIBLE_PX:g} px everywhere"
        fix = "calibrate with that model"
        raise problem(path, expected, f"another one, with {px:.2f} px, in {camera.id}", fix)
    check_lens(camera, path)
    print(f"{camera.id}: its lens moves pixels by up to {px:.2f} px")
    return camera
