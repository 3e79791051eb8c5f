"""Estimated poses against calibrated ones: alignment by a similarity (Sim3), and errors with and without it.

Poses estimated from images alone are in a frame of their own: rotated, translated and scaled. The similarity from it
to the scene's frame is found from the cameras' centres and one point along each of their axes (the idea of DUSt3R's
alignment of posed views): centres alone leave a rig in a line free to roll, and a rig in a plane open to reflection.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera

# Length of the axes, in median distances between cameras. A narrow array determines its rotations better than its
# positions: on structure from motion of two scenes, longer axes left 0.2 and 0.1 px between the projections of the
# scene into the aligned and into the calibrated views, axes of 1 left 0.4 and 0.8.
REACH = 10.0
THRESHOLDS_DEG = (5, 15)  # of RRA and RTA
MAA_DEG = 30  # of the mean average accuracy


@dataclass(frozen=True, eq=False)
class Sim3:
    """A similarity x -> scale R x + t. R is [3, 3], t is [3]."""

    scale: float
    R: Float64
    t: Float64

    def __call__(self, points: Float64) -> Float64:
        """Return points [N, 3] transformed."""
        return np.asarray(self.scale * points @ self.R.T + self.t)

    def camera(self, camera: Camera) -> Camera:
        """Return the camera that projects transformed points to the pixels to which `camera` projects the points."""
        R = camera.R @ self.R.T
        return replace(camera, R=R, t=-R @ self(camera.center[None])[0])


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of N cameras after the alignment, and of their N (N - 1) / 2 pairs, which need none."""

    rotation_deg: Float64  # [N]
    translation_m: Float64  # [N]
    array_m: float  # radius of the true array: largest distance of a camera from their mean
    pair_rotation_deg: Float64  # [P]
    pair_direction_deg: Float64  # [P]

    def summary(self) -> dict[str, float]:
        """Return means over cameras (largest too), and shares of pairs below thresholds; units in the names."""
        worst = np.maximum(self.pair_rotation_deg, self.pair_direction_deg)
        accuracy: dict[str, float] = {}
        for name, errors in (("rra", self.pair_rotation_deg), ("rta", self.pair_direction_deg)):
            accuracy |= {f"{name}_{limit}": float(np.mean(errors < limit)) for limit in THRESHOLDS_DEG}
        return {
            "rotation_deg": float(self.rotation_deg.mean()),
            "rotation_max_deg": float(self.rotation_deg.max()),
            "translation_m": float(self.translation_m.mean()),
            "translation_max_m": float(self.translation_m.max()),
            "translation_of_array": float(self.translation_m.mean() / self.array_m),
            **accuracy,
            f"maa_{MAA_DEG}": float(np.mean([np.mean(worst < limit) for limit in range(1, MAA_DEG + 1)])),
        }


def umeyama(source: Float64, target: Float64) -> Sim3:
    """Return the similarity that takes points [N, 3] to their partners with the least sum of squares (Umeyama 1991).

    A reflection is never returned: the sign goes to the direction of the smallest singular value.
    Raises UserError for points that do not determine it: fewer than 3, coincident, or on one line; and for points that
    are not finite.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        found = f"{source.shape} and {target.shape}"
        raise problem("similarity", "two lists of points of one shape [N, 3]", found, "pair the points")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise problem("similarity", "finite points", "NaN or infinity", "correct the poses or points")
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a / len(a))
    if len(a) < 3 or not s[1] > 1e-12 * s[0]:
        expected = "at least 3 points that are not on one line"
        raise problem("similarity", expected, f"{len(a)} without", "add points or axes")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    R = u @ np.diag(signs) @ vt
    scale = float(s @ signs / np.mean(np.sum(a * a, axis=1)))
    return Sim3(scale, R, target.mean(axis=0) - scale * R @ source.mean(axis=0))


def align_cameras(estimated: Sequence[Camera], true: Sequence[Camera]) -> Sim3:
    """Return the similarity from the frame of the estimated cameras to that of the true ones, camera by camera.

    Raises UserError for fewer than 2 cameras, different counts, or cameras that are all at one position.
    """
    if len(estimated) != len(true) or len(true) < 2:
        found = f"{len(estimated)} estimated and {len(true)} true ones"
        raise problem("alignment", "two or more cameras of both kinds", found, "pair the cameras")
    return umeyama(_skeleton(estimated), _skeleton(true))


def _skeleton(cameras: Sequence[Camera]) -> Float64:
    """Return centres, and points along the axes at `REACH` median distances [4 N, 3]: they scale as the cameras do."""
    centers = np.stack([c.center for c in cameras])
    distances = np.linalg.norm(centers[:, None] - centers[None], axis=-1)[np.triu_indices(len(cameras), 1)]
    reach = REACH * float(np.median(distances))
    if not reach > 1e-12 * max(1.0, float(np.abs(centers).max())):
        expected, fix = "cameras at different positions", "use cameras with a baseline"
        raise problem("alignment", expected, "all at one position", fix)
    axes = np.stack([c.R for c in cameras])  # [N, 3, 3], rows are the axes in world coordinates
    return np.concatenate([centers, (centers[:, None] + reach * axes).reshape(-1, 3)])


def angle_deg(R: Float64) -> Float64:
    """Return angles [...] of rotations [..., 3, 3] in degrees; unlike arccos of the trace, exact near 0 and 180."""
    sine = 0.5 * np.linalg.norm(
        np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1), axis=-1
    )
    return np.asarray(np.degrees(np.arctan2(sine, 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1))))


def pose_errors(estimated: Sequence[Camera], true: Sequence[Camera]) -> PoseErrors:
    """Return the errors of estimated cameras in any frame, aligned to the true ones first. Raises as `align_cameras`.

    Pairs are compared as Fast3R and others do, relative rotation and direction of relative translation, but a
    direction that points the opposite way counts as 180 degrees off and is not folded to 0.
    """
    align = align_cameras(estimated, true)
    aligned = [align.camera(c) for c in estimated]
    centers = np.stack([c.center for c in true])
    shift = np.stack([c.center for c in aligned]) - centers
    turn = np.stack([a.R @ b.R.T for a, b in zip(aligned, true, strict=True)])
    i, j = np.triu_indices(len(true), 1)
    (R, d), (R_true, d_true) = (_relative(cameras, i, j) for cameras in (estimated, true))
    across, along = np.linalg.norm(np.cross(d, d_true), axis=-1), np.sum(d * d_true, axis=-1)
    return PoseErrors(
        rotation_deg=angle_deg(turn),
        translation_m=np.linalg.norm(shift, axis=-1),
        array_m=float(np.linalg.norm(centers - centers.mean(axis=0), axis=-1).max()),
        pair_rotation_deg=angle_deg(R @ R_true.transpose(0, 2, 1)),
        pair_direction_deg=np.degrees(np.arctan2(across, along)),
    )


def _relative(cameras: Sequence[Camera], i: NDArray[Any], j: NDArray[Any]) -> tuple[Float64, Float64]:
    """Return rotations [P, 3, 3] from cameras i to cameras j, and the centres of j in the frames of i [P, 3]."""
    R, centers = np.stack([c.R for c in cameras]), np.stack([c.center for c in cameras])
    return R[j] @ R[i].transpose(0, 2, 1), np.einsum("pij,pj->pi", R[i], centers[j] - centers[i])
