"""Camera poses from MSDI's points: PnP with RANSAC per view, with or without known intrinsics (section 3.3).

Each pixel of a view has the point that it sees, in view 0's frame. SQPnP within RANSAC finds the pose under which
most points fall on their pixels; Levenberg-Marquardt refines it on those, twice, the second time on what the first
result counts in. Where no pose holds, the view has none, with the reason; a wrong pose is worse than no pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64

if TYPE_CHECKING:
    from spike4dgs.method.msdi.network import Estimate


# DUSt3R and Fast3R take 10 rounds at 5 px of 512. With a third of the points right, a sample of four is right in one
# of 81 rounds: 10 rounds mostly miss. RANSAC stops by itself once it is sure.
ROUNDS = 2000
CERTAINTY = 0.9999
REACH = 0.01  # of the image's longer side: a point within this distance of its pixel is an inlier
LEAST_INLIERS = 0.1  # share of the points below which a pose counts as none
LEAST_CONFIDENCE = 0.3  # quantile of a view's confidence below which its points are left out
MOST_POINTS = 4000  # random sample of a view's points; more take longer and give the same poses
FOCAL_ROUNDS = 10
LEAST_POINTS = 6


@dataclass(frozen=True, eq=False)
class ViewPose:
    """A view's pose, or the reason why there is none."""

    w2c: Float64 | None  # [4, 4] from view 0's frame to the camera's, OpenCV axes
    focal_px: float | None  # estimated, where the intrinsics were unknown
    reason: str = ""  # why there is no pose

    @property
    def found(self) -> bool:
        """True if there is a pose."""
        return self.w2c is not None


def poses_of(estimate: Estimate, intrinsics: Float64 | None, seed: int = 0) -> list[list[ViewPose]]:
    """Return the poses of each sample's views; `intrinsics` [B, V, 3, 3] or None. See `solve_poses`."""
    points = estimate.points.detach().double().cpu().numpy()
    confidence = estimate.confidence.detach().double().cpu().numpy()
    known = [None] * len(points) if intrinsics is None else list(intrinsics)
    return [solve_poses(p, c, K, seed) for p, c, K in zip(points, confidence, known, strict=True)]


def solve_poses(points: Float64, confidence: Float64, intrinsics: Float64 | None, seed: int = 0) -> list[ViewPose]:
    """Return the pose of each view from points [V, H, W, 3] in view 0's frame and their confidence [V, H, W].

    `intrinsics` [V, 3, 3] are in pixels. Where they are None, the focal length of view 0's points serves all views,
    with square pixels and the principal point in the middle. View 0's pose is the identity by definition. The same
    seed gives the same poses. Nothing is raised for bad points: such a view has no pose.
    """
    height, width = confidence.shape[1:]
    chosen = [_chosen(p, c, seed) for p, c in zip(points, confidence, strict=True)]
    focal = None
    if intrinsics is None:
        pixels, at = chosen[0]
        focal = focal_from_points(at, pixels - np.array([width / 2, height / 2]))
        if focal is None:
            return [ViewPose(None, None, "no focal length fits the points of view 0")] * len(points)
        intrinsics = np.tile([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]], (len(points), 1, 1))
    reach_px = REACH * max(height, width)
    poses = [ViewPose(np.eye(4), focal)]
    for (pixels, at), K in zip(chosen[1:], intrinsics[1:], strict=True):
        poses.append(_pose(at, pixels, np.asarray(K, np.float64), focal, reach_px, seed))
    return poses


def _pose(points: Float64, pixels: Float64, K: Float64, focal: float | None, reach_px: float, seed: int) -> ViewPose:
    if len(points) < LEAST_POINTS:
        return ViewPose(None, focal, f"{len(points)} usable points, fewer than {LEAST_POINTS}")
    found = solve_pose(points, pixels, K, seed, reach_px=reach_px)
    if found is None:
        return ViewPose(None, focal, "no pose agrees with the points")
    share = float(_inliers(*found, points, pixels, K, reach_px).mean())
    if share < LEAST_INLIERS:
        return ViewPose(None, focal, f"the best pose agrees with {share:.0%} of the points")
    w2c = np.eye(4)
    w2c[:3, :3], w2c[:3, 3] = found
    return ViewPose(w2c, focal)


def solve_pose(
    points: Float64, pixels: Float64, K: Float64, seed: int, *, reach_px: float
) -> tuple[Float64, Float64] | None:
    """Return world-to-camera (R [3, 3], t [3]) from points [N, 3] and pixels [N, 2], or None if RANSAC finds none.

    Points within `reach_px` of their pixel are inliers. The same seed gives the same pose.
    """
    # Points of unit size around the origin, which changes no pixel: OpenCV's thresholds assume such numbers.
    middle = np.median(points, axis=0)
    size = float(np.median(np.linalg.norm(points - middle, axis=1)))
    if not size > 0:
        return None
    points, pixels = (np.ascontiguousarray(x, np.float64) for x in ((points - middle) / size, pixels))
    cv2.setRNGSeed(seed % 2**31)  # a C int
    try:
        found, turn, shift, inliers = cv2.solvePnPRansac(
            points,
            pixels,
            K,
            None,
            iterationsCount=ROUNDS,
            reprojectionError=reach_px,
            confidence=CERTAINTY,
            flags=cv2.SOLVEPNP_SQPNP,
        )
        if not found or inliers is None or len(inliers) < LEAST_POINTS:
            return None
        good = inliers[:, 0]
        for _ in range(2):
            turn, shift = cv2.solvePnPRefineLM(points[good], pixels[good], K, None, turn, shift)
            R, t = np.asarray(cv2.Rodrigues(turn)[0], np.float64), np.asarray(shift[:, 0], np.float64)
            good = np.flatnonzero(_inliers(R, t, points, pixels, K, reach_px))
            if len(good) < LEAST_POINTS:
                return None
    except cv2.error:  # degenerate points, such as all on a line
        return None
    if not (np.isfinite(R).all() and np.isfinite(t).all()):
        return None
    return R, np.asarray(size * t - R @ middle, np.float64)


def _inliers(
    R: Float64, t: Float64, points: Float64, pixels: Float64, K: Float64, reach_px: float
) -> NDArray[np.bool_]:
    """Return which points [N, 3] are in front of the camera and within `reach_px` of their pixels [N, 2]."""
    p = points @ R.T + t
    ahead = p[:, 2] > 1e-9
    q = p @ K.T
    uv = q[:, :2] / np.where(ahead, p[:, 2], 1.0)[:, None]
    return ahead & (np.linalg.norm(uv - pixels, axis=1) <= reach_px)


def _chosen(points: Float64, confidence: Float64, seed: int) -> tuple[Float64, Float64]:
    """Return the pixel centres [N, 2] and points [N, 3] of a view's finite points of sufficient confidence."""
    usable = np.isfinite(points).all(axis=-1) & np.isfinite(confidence)
    if usable.any():
        usable &= confidence >= np.quantile(confidence[usable], LEAST_CONFIDENCE)
    v, u = np.nonzero(usable)
    if len(v) > MOST_POINTS:
        few = np.sort(np.random.default_rng(seed).permutation(len(v))[:MOST_POINTS])
        v, u = v[few], u[few]
    return np.stack([u + 0.5, v + 0.5], axis=-1), points[v, u]


def focal_from_points(points: Float64, offsets: Float64) -> float | None:
    """Return the focal length f in px that minimises sum |p - f q|, q = (x / z, y / z) of points [N, 3] (Weiszfeld).

    `offsets` p [N, 2] are pixels relative to the principal point. Each round solves least squares, weighted by the last
    round's residuals; points that are not in front of the camera are left out. None if no positive one fits.
    """
    ahead = points[:, 2] > 1e-9
    q, p = points[ahead, :2] / points[ahead, 2:], offsets[ahead]
    qp, qq = np.sum(q * p, axis=1), np.sum(q * q, axis=1)
    if not qq.sum() > 0:
        return None
    focal = qp.sum() / qq.sum()
    for _ in range(FOCAL_ROUNDS):
        weights = 1 / np.maximum(np.linalg.norm(p - focal * q, axis=1), 1e-8)
        focal = (weights * qp).sum() / (weights * qq).sum()
    return float(focal) if focal > 0 else None
