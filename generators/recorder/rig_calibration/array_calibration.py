"""`calibrate-rig`: intrinsics and pose of every camera, from clips of a chessboard that moves in front of the array."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.pose_error import Sim3, align_cameras, pose_errors
from spike4dgs.benchmark.scene.cameras import Camera, array_axes, check_lens
from spike4dgs.benchmark.scene.lens import make_distortion
from spike4dgs.generators.recorder.rig_calibration.board import Board
from spike4dgs.generators.recorder.rig_calibration.bundle_adjustment import (
    Adjusted,
    Detections,
    Freedom,
    Rig,
    adjust,
    rms_px,
    trimmed,
)
from spike4dgs.generators.recorder.rig_calibration.initial_rig import estimate_rig

WORST_PX, MOST_LEFT_OUT = 1.0, 0.25  # limits of reprojection error and of rejected corners; beyond, the fit has failed
WORST_FOCAL = 0.03  # limit of a focal length's standard deviation; a well tilted board leaves 0.005 at most
WORST_LENS_PX = 1.0  # limit of the standard deviation of what a lens does to the image's corners
_REACH = "move the board into the corners of all images, or leave --distortion out"


@dataclass(frozen=True, eq=False)
class ArrayCalibration:
    """The result of `calibrate_array`. Cameras are in the array's own frame, see `levelled`."""

    cameras: tuple[Camera, ...]
    adjusted: Adjusted
    detections: Detections
    reference: int
    reprojection_px: float  # root mean square over the used corners
    per_camera_px: tuple[float, ...]

    @property
    def corners(self) -> tuple[int, int]:
        """Return the number of used corners, and of those left out."""
        return int(self.detections.used.sum()), int((~self.detections.used).sum())


def calibrate_array(
    detections: Detections, board: Board, names: Sequence[str], size: tuple[int, int], freedom: Freedom
) -> ArrayCalibration:
    """Return intrinsics and poses from detections; corners that do not fit are left out. `size`: width, height.

    Raises UserError where a camera has too few detections, where no array of pinholes explains them, or where they
    leave a focal length or a lens open.
    """
    points = board.corners
    initial, reference = estimate_rig(detections, points, names, size)
    rough = adjust(initial, detections, points, reference, freedom)
    used = trimmed(rough.rig, detections, points)
    found = adjust(rough.rig, used, points, reference, freedom)
    used = trimmed(found.rig, detections, points)  # what fits now, and did not beside those that are left out
    found = adjust(found.rig, used, points, reference, freedom)
    error = rms_px(found.rig, used, points)
    left_out = float(np.mean(~used.used))
    each = tuple(rms_px(found.rig, used.of(used.camera == c), points) for c in range(len(names)))
    lost = [float(np.mean(~used.used[used.camera == c])) for c in range(len(names))]
    facts = zip(names, each, lost, strict=True)
    wrong = [name for name, own, share in facts if not (own < WORST_PX and share < MOST_LEFT_OUT)]
    if wrong or not (error < WORST_PX and left_out < MOST_LEFT_OUT):
        expected = (
            f"a reprojection error below {WORST_PX:g} px, and at least {1 - MOST_LEFT_OUT:.0%} of the corners in it"
        )
        fix = "check that all cameras share one clock and one orientation (`rows`, `mirrored`), and --columns, --rows"
        named = f"; other cameras than {', '.join(wrong)} agree" if 0 < len(wrong) < len(names) else ""
        raise problem("array", expected, f"{error:.2f} px with {1 - left_out:.0%} of them{named}", fix)
    focal = found.rig.focal
    unknown = np.where(focal > 0, found.focal_px / focal, np.inf)
    if not unknown.max() < WORST_FOCAL:
        expected = f"focal lengths to {WORST_FOCAL:.0%}, one standard deviation"
        fix = "tilt the board to all sides by 20 to 40 degrees, or add --shared-focal or --centered if that is so"
        raise problem("array", expected, f"{unknown.max():.1%} for {names[int(unknown.argmax())]}", fix)
    cameras = levelled(found.rig, names, size)
    if found.lens is not None:
        _check_lenses(cameras, found.lens)
    return ArrayCalibration(cameras, found, used, reference, error, each)


def _check_lenses(cameras: Sequence[Camera], covariances: Float64) -> None:
    """Raise UserError where a lens folds within the image, or covariances [C, 2, 2] of k1 and k2 leave it open."""
    for camera, covariance in zip(cameras, covariances, strict=True):
        x, y = (max(at, side - at) for at, side in ((camera.cx, camera.width), (camera.cy, camera.height)))
        radius = math.hypot(x, y) / camera.fx
        powers = camera.fx * np.array([radius**3, radius**5])
        if not (sd := math.sqrt(powers @ covariance @ powers)) < WORST_LENS_PX:
            expected = f"lenses to {WORST_LENS_PX:g} px in the corners of the image, one standard deviation"
            raise problem("array", expected, f"{sd:.1f} px for {camera.id}", _REACH)
        check_lens(camera, "array", _REACH)


def levelled(rig: Rig, names: Sequence[str], size: tuple[int, int]) -> tuple[Camera, ...]:
    """Return the cameras in the array's own frame: z up, y the viewing direction, x to its right; all as means.

    The origin is the mean position of the board: about the point that the array looks at.
    """
    lenses = [()] * len(names) if rig.lens is None else [make_distortion(k.tolist()) for k in rig.lens]
    cameras = [
        Camera(name, *size, float(f), float(f), float(m[0]), float(m[1]), R, t, lens)
        for name, f, m, R, t, lens in zip(names, rig.focal, rig.principal, rig.R, rig.t, lenses, strict=True)
    ]
    W = array_axes(cameras)
    frame = Sim3(1.0, W, -W @ rig.board_t.mean(axis=0))
    return tuple(map(frame.camera, cameras))


def differences(found: Sequence[Camera], stated: Mapping[str, Camera]) -> dict[str, float] | None:
    """Return the errors against the cameras that a clip states, after the best similarity; None where it has none."""
    known = [stated[c.id] for c in found if c.id in stated]
    if len(known) < max(len(found), 2):
        return None
    errors, scale = pose_errors(found, known).summary(), align_cameras(found, known).scale
    names = ("rotation_deg", "rotation_max_deg", "translation_m", "translation_max_m")
    focal = [abs(a.fx / b.fx - 1) for a, b in zip(found, known, strict=True)]
    principal = [np.hypot(a.cx - b.cx, a.cy - b.cy) for a, b in zip(found, known, strict=True)]
    return {name: errors[name] for name in names} | {
        "scale": abs(1 / scale - 1),
        "focal_max": max(focal),
        "principal_point_max_px": float(max(principal)),
    }
