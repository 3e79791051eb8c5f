"""Cameras of a COLMAP model, text or binary, read by pycolmap."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.exchange.foreign_camera import Distort, FoundCamera, check_same, check_size, make_camera
from spike4dgs.benchmark.lazy import kept_sigterm
from spike4dgs.benchmark.scene.writer import colmap_distortion

_MOST_BYTES = 1 << 28  # of cameras or images, these with their points
_CAMERA_BYTES = 48  # at least, in cameras.bin
_POSE_BYTES, _POINT_BYTES = 64, 24  # in images.bin: before the name of an image, and of each of its points


def read_colmap_model(folder: Path, names: Collection[str], size: tuple[int, int]) -> Mapping[str, FoundCamera | None]:
    """Return the cameras of a model's registered images, by the stream that an image belongs to.

    An image belongs to the stream of its name, with or without suffix, or of its folder: `cam_00`, `cam_00.png`,
    `cam_00/000120.png`. For images without a stream there is None. Raises UserError where the model cannot be read,
    and where images of one stream have different cameras.
    """
    with kept_sigterm():
        import pycolmap

    if not any((folder / f"cameras.{kind}").is_file() for kind in ("bin", "txt")):
        raise problem(folder, "a COLMAP model (cameras.bin or cameras.txt, ...)", "none", "give its folder: sparse/0")
    try:
        with tempfile.TemporaryDirectory() as lean:
            _write_cameras_and_poses(folder, Path(lean))
            model = pycolmap.Reconstruction(lean)
    except (ValueError, RuntimeError, OSError, IndexError, MemoryError) as e:
        raise problem(folder, "a whole COLMAP model", f"a damaged one ({str(e)[:200]})", "export it again") from None
    found: dict[str, FoundCamera] = {}
    others = set()
    for image in sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name):
        if (name := _stream_of(image.name, names)) not in names:
            others.add(name)
            continue
        camera = model.cameras[image.camera_id]
        check_size((camera.width, camera.height), size, name, folder)
        made = _camera(name, image, camera, folder)
        check_same(found.setdefault(name, made), made, image.name, folder)
    return {**dict.fromkeys(others), **found}


def _write_cameras_and_poses(folder: Path, out: Path) -> None:
    """Write a copy of a model without points, rigs and frames: a camera and a pose for each image.

    pycolmap believes the numbers in a file: it would read on for hours, or take memory for points that are not there.
    Raises ValueError where the files contradict themselves.
    """
    kind = "bin" if (folder / "cameras.bin").is_file() else "txt"
    cameras, images = (folder / f"{name}.{kind}" for name in ("cameras", "images"))
    if cameras.stat().st_size > _MOST_BYTES or images.stat().st_size > _MOST_BYTES:
        raise ValueError(f"more than {_MOST_BYTES} bytes of cameras or images")
    data = cameras.read_bytes()
    if kind == "bin" and len(data) < 8 + _CAMERA_BYTES * int.from_bytes(data[:8], "little"):
        raise ValueError(f"{int.from_bytes(data[:8], 'little')} cameras in {len(data)} bytes")
    (out / cameras.name).write_bytes(data)
    poses = _binary_poses if kind == "bin" else _text_poses
    (out / images.name).write_bytes(poses(images.read_bytes()))
    (out / f"points3D.{kind}").write_bytes(bytes(8) if kind == "bin" else b"")


def _binary_poses(data: bytes) -> bytes:
    parts, at = [data[:8]], 8
    for _ in range(int.from_bytes(data[:8], "little")):
        end = data.find(b"\0", at + _POSE_BYTES) + 1  # of the name
        count = int.from_bytes(data[end : end + 8], "little")
        if end == 0 or (stop := end + 8 + _POINT_BYTES * count) > len(data):
            raise ValueError("images.bin ends within an image")
        data[at + _POSE_BYTES : end].decode()  # ValueError for a name that is none
        parts.append(data[at:end] + bytes(8))
        at = stop
    return b"".join(parts)


def _text_poses(data: bytes) -> bytes:
    """Return the text of images.txt without the images' points: of every two lines the second is empty."""
    lines, poses = iter(data.decode().split("\n")), []  # ValueError for other bytes
    for line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            poses.append(line.strip() + "\n\n")
            next(lines, None)  # the image's points
    return "".join(poses).encode()


def _stream_of(image: str, names: Collection[str]) -> str:
    """Return the stream of an image; where there is none, the image's folder, or its name without suffix."""
    path = PurePosixPath(image)
    candidates = (image, (path.parent / path.stem).as_posix(), *path.parts[:1], path.stem)
    other = path.parts[0] if len(path.parts) > 1 else path.stem
    return next((name for name in candidates if name in names), other)


def _camera(name: str, image: Any, camera: Any, folder: Path) -> FoundCamera:
    try:
        K, pose = camera.calibration_matrix(), image.cam_from_world()
    except ValueError:
        fix = "calibrate it with a model that has a focal length"
        raise problem(folder, f"a perspective camera of {name}", camera.model.name, fix) from None
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
