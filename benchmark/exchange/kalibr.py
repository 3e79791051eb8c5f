"""Cameras of Kalibr's `camchain.yaml`: a pinhole for each camera, and the transform from the camera before it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.exchange.found_camera import (
    CENTRE,
    FoundCamera,
    check_size,
    fisheye_distortion,
    make_camera,
    with_brown_lens,
)
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.untrusted.yaml_file import read_yaml

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
    for i, (name, entry) in enumerate(sorted(chain.items(), key=lambda item: (len(str(item[0])), str(item[0])))):
        try:
            model, intrinsics, resolution = entry["camera_model"], entry["intrinsics"], entry["resolution"]
            if i:
                w2c = np.asarray(entry["T_cn_cnm1"], np.float64).reshape(4, 4) @ w2c
            lens, coefficients = entry["distortion_model"], np.asarray(entry["distortion_coeffs"], np.float64)
        except (KeyError, TypeError, ValueError) as e:
            expected = f"{_KEYS} and, after the first, a 4x4 T_cn_cnm1 of {name}"
            raise problem(path, expected, repr(e), "calibrate again") from None
        if model != "pinhole":
            raise problem(path, f"camera_model pinhole of {name}", repr(model), "calibrate with that model")
        check_size(tuple(resolution) if isinstance(resolution, list) else (resolution,), size, str(name), path)
        camera = make_camera(str(name), size, intrinsics, w2c[:3, :3], w2c[:3, 3], path, CENTRE)
        found[str(name)] = _with_lens(camera, lens, coefficients, path)
    return found


def _with_lens(camera: Camera, lens: Any, coefficients: Any, path: Path) -> FoundCamera:
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
