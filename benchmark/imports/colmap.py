"""Cameras of a COLMAP model, text or binary, read by pycolmap."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from spike4dgs.benchmark.array.lens import NAMES
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.imports.found_camera import Distort, Float64, FoundCamera, check_size, make_camera
from spike4dgs.benchmark.scene.writer import colmap_distortion

_POINT_BYTES = 43  # at least, in points3D.bin
_SAME = 1e-9  # relative: images of one camera that have the same pose


def read_colmap_model(folder: Path, names: Collection[str], size: tuple[int, int]) -> dict[str, FoundCamera]:
    """Return the cameras of a model's registered images, by the stream that an image belongs to.

    An image belongs to the stream of its name, with or without suffix, or of its folder: `cam_00`, `cam_00.png`,
    `cam_00/000120.png`. Images without a stream are left out. Raises UserError where the model cannot be read, and
    where images of one stream have different cameras.
    """
    import pycolmap

    if not any((folder / f"cameras.{kind}").is_file() for kind in ("bin", "txt")):
        raise problem(folder, "a COLMAP model (cameras.bin or cameras.txt, ...)", "none", "give its folder: sparse/0")
    _check_points(folder / "points3D.bin")
    try:
        model = pycolmap.Reconstruction(str(folder))
    except (ValueError, RuntimeError, OSError, IndexError, MemoryError) as e:
        raise problem(folder, "a whole COLMAP model", f"a damaged one ({e})", "export it again") from None
    found: dict[str, FoundCamera] = {}
    for image in sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name):
        name, camera = _stream_of(image.name, names), model.cameras[image.camera_id]
        if name in names:
            check_size((camera.width, camera.height), size, name, folder)
        made = _camera(name, image, camera, folder)
        first = found.setdefault(name, made)
        if name in names and not _equal(first, made):
            fix = "export a model in which each camera stands still and has one set of intrinsics"
            raise problem(folder, f"one camera and pose for all images of {name}", f"another in {image.name}", fix)
    return found


def _check_points(path: Path) -> None:
    """Raise UserError where the file is too small for its points: pycolmap would take memory for all that it claims."""
    if path.is_file():
        with open(path, "rb") as file:
            count = int.from_bytes(file.read(8), "little")
        if path.stat().st_size < 8 + _POINT_BYTES * count:
            raise problem(path, f"{count} points", "a shorter file", "export the model again")


def _stream_of(image: str, names: Collection[str]) -> str:
    """Return the stream of an image; where there is none, the image's folder, or its name without suffix."""
    path = PurePosixPath(image)
    candidates = (image, path.with_suffix("").as_posix(), path.stem, path.parts[0])
    other = path.parts[0] if len(path.parts) > 1 else path.stem
    return next((name for name in candidates if name in names), other)


def _camera(name: str, image: Any, camera: Any, folder: Path) -> FoundCamera:
    K, pose = camera.calibration_matrix(), image.cam_from_world()
    intrinsics = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    size = camera.width, camera.height
    made = make_camera(name, size, intrinsics, pose.rotation.matrix(), pose.translation, folder)
    lens = colmap_distortion(camera)
    if lens is None:
        return FoundCamera(made, _distortion(camera, intrinsics))
    return FoundCamera(replace(made, distortion=lens))


def _distortion(camera: Any, intrinsics: tuple[float, float, float, float]) -> Distort:
    fx, fy, cx, cy = intrinsics

    def distort(xy: Float64) -> Float64:
        uv = np.asarray(camera.img_from_cam(np.concatenate([xy, np.ones((len(xy), 1))], axis=1)))
        return np.asarray((uv - (cx, cy)) / (fx, fy))

    return distort


def _equal(a: FoundCamera, b: FoundCamera) -> bool:
    """Return whether two cameras have the same intrinsics and pose, and as much distortion."""

    def numbers(f: FoundCamera) -> Float64:
        lens = f.camera.distortion or (0.0,) * len(NAMES)
        return np.concatenate([f.camera.K.ravel(), f.camera.w2c.ravel(), lens, [f.distortion_px]])

    first, second = numbers(a), numbers(b)
    return bool(np.allclose(first, second, rtol=_SAME, atol=_SAME))
