"""A camera from another program's file, and a lens that OpenCV's model of five numbers does not describe."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera, check_rotation, distortion_px
from spike4dgs.benchmark.scene.lens import NAMES, make_distortion

Distort = Callable[[Float64], Float64]  # normalised image coordinates [N, 2] of a pinhole -> of the lens

CENTRE = 0.5  # added to principal points of OpenCV and Kalibr, whose pixel centres are at whole numbers
_SAME = 1e-9  # relative: images of one camera that have the same pose


@dataclass(frozen=True, eq=False)
class FoundCamera:
    """A camera of a file, and its lens where the camera cannot hold it."""

    camera: Camera
    distort: Distort | None = None

    @property
    def distortion_px(self) -> float:
        """The farthest that the lens moves a point of the pinhole's image, in pixels."""
        return distortion_px(self.camera, self.distort)


def make_camera(
    name: str, size: tuple[int, int], intrinsics: Any, R: Any, t: Any, where: Path, centre: float = 0.0
) -> Camera:
    """Return a camera of fx, fy, cx, cy and a world-to-camera pose (OpenCV axes).

    Raises UserError for other shapes, numbers that are not finite, and matrices that are no rotations.
    """
    try:
        fx, fy, cx, cy = (float(v) for v in intrinsics)
        R, t = np.asarray(R, np.float64).reshape(3, 3), np.asarray(t, np.float64).reshape(3)
    except (TypeError, ValueError) as e:
        expected = f"fx, fy, cx, cy, a 3x3 rotation and 3 coordinates of {name}"
        raise problem(where, expected, str(e), "calibrate again") from None
    if not (fx > 0 and fy > 0 and np.isfinite([fx, fy, cx, cy, *t]).all()):
        found = f"fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}, position {t.tolist()}"
        raise problem(where, f"finite numbers and positive focal lengths of {name}", found, "calibrate again")
    check_rotation(R, f"{where}, camera {name}")
    return Camera(name, *size, fx, fy, cx + centre, cy + centre, R, t)


def check_size(found: Any, size: tuple[int, int], name: str, where: Path) -> None:
    """Raise UserError unless a file's (width, height) of a camera is the streams'."""
    if found != size:
        expected = f"{size[0]}x{size[1]} pixels for {name}, as the streams have"
        raise problem(where, expected, "x".join(map(str, found)), "correct --width and --height, or calibrate again")


def check_same(first: FoundCamera, found: FoundCamera, image: str, where: Path) -> None:
    """Raise UserError unless an image's camera has the intrinsics, the lens and the pose of an earlier image's."""

    def numbers(f: FoundCamera) -> Float64:
        c = f.camera
        lens = c.distortion or (0.0,) * len(NAMES)
        return np.array([c.width, c.height, *c.K.ravel(), *c.w2c.ravel(), *lens, f.distortion_px])

    if not np.allclose(numbers(first), numbers(found), rtol=_SAME, atol=_SAME):
        fix = "export one in which each camera stands still and has one set of intrinsics"
        raise problem(where, f"one camera and pose for all images of {first.camera.id}", f"another in {image}", fix)


def with_brown_lens(camera: Camera, coefficients: Float64) -> FoundCamera:
    """Return a camera with OpenCV's lens model of k1, k2, p1, p2[, k3[, k4, k5, k6[, s1 ... s4[, tx, ty]]]]."""
    if not coefficients[len(NAMES) :].any():
        return FoundCamera(replace(camera, distortion=make_distortion(coefficients[: len(NAMES)].tolist())))
    return FoundCamera(camera, brown_distortion(coefficients))


def brown_distortion(coefficients: Float64) -> Distort:
    """Return that lens model with all of its coefficients."""
    import cv2

    def distort(xy: Float64) -> Float64:
        rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        zero, K = np.zeros(3), np.eye(3)
        return np.asarray(cv2.projectPoints(rays, zero, zero, K, coefficients)[0], np.float64).reshape(-1, 2)

    return distort


def fisheye_distortion(coefficients: Float64) -> Distort:
    """Return the equidistant lens model of k1 ... k4, which is no pinhole even where all are zero."""

    def distort(xy: Float64) -> Float64:
        radius = np.linalg.norm(xy, axis=1, keepdims=True)
        angle = np.arctan(radius)
        powers = angle ** np.array([2, 4, 6, 8])  # [N, 4]
        bent = angle * (1 + powers @ coefficients[:, None])
        return np.asarray(xy * np.where(radius > 0, bent / np.where(radius > 0, radius, 1), 1))

    return distort
