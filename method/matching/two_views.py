"""Relative poses of pairs of views by essential matrices, and the poses of all views that agree with them.

OpenCV finds each pair's essential matrix (MAGSAC++). Rotations are averaged by least squares with a robust loss; the
directions between the cameras then give the centres, as the null vector of linear equations (c_j - c_i) x d_ij = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.method.matching.tracks import Matches

LEAST_MATCHES = 12
_CERTAINTY = 0.9999
_ROUNDS = 5000
_FARTHEST = 1e5  # baselines: OpenCV's own 50 leaves out all that a narrow pair sees
_NEAR_RAD = 0.02  # of a pair's rotation to the mean: beyond it the loss is linear


@dataclass(frozen=True, eq=False)
class Relative:
    """The pose of view j relative to view i: x_j = R x_i + t, t of unit length."""

    R: Float64
    t: Float64
    inliers: int


def relative_pose(a: Float64, b: Float64, focal: float, reach_px: float) -> Relative | None:
    """Return the pose that agrees with points `a` and `b` [M, 2] at focal length 1, or None where there is none.

    A match within `reach_px` of its epipolar line, at focal length `focal` px, is an inlier.
    """
    if len(a) < LEAST_MATCHES:
        return None
    # In pixels: OpenCV's thresholds assume such numbers.
    a, b, K = focal * a, focal * b, np.diag([focal, focal, 1.0])
    cv2.setRNGSeed(0)
    E, mask = cv2.findEssentialMat(
        a, b, K, method=cv2.USAC_MAGSAC, prob=_CERTAINTY, threshold=reach_px, maxIters=_ROUNDS
    )
    if E is None or E.shape != (3, 3):
        return None
    inliers, R, t, *_ = cv2.recoverPose(E, a, b, K, distanceThresh=_FARTHEST, mask=mask)
    turn, way = (np.asarray(x, np.float64) for x in (R, t[:, 0]))
    return Relative(turn, way, int(inliers)) if inliers >= LEAST_MATCHES else None


def relative_poses(matches: Matches, K: Float64, reach_px: float) -> dict[tuple[int, int], Relative]:
    """Return the relative poses of pairs (i, j), i < j, from the matches of both directions."""
    found = {}
    for i, j in sorted({(min(p), max(p)) for p in matches}):
        a, b = [], []
        for r, s in ((i, j), (j, i)):
            if (r, s) in matches:
                m = matches[r, s]
                ends = normalized(m.at, K[r]), normalized(m.uv, K[s])
                a.append(ends[0] if r == i else ends[1])
                b.append(ends[1] if r == i else ends[0])
        pose = relative_pose(np.concatenate(a), np.concatenate(b), float(K[[i, j], 0, 0].mean()), reach_px)
        if pose:
            found[i, j] = pose
    return found


def normalized(uv: Float64, K: Float64) -> Float64:
    """Return where the rays of pixels [M, 2] cross the plane z = 1."""
    return np.ascontiguousarray((uv - K[:2, 2]) / K[[0, 1], [0, 1]])


def averaged(pairs: dict[tuple[int, int], Relative], views: int) -> tuple[Float64, Float64] | None:
    """Return rotations [V, 3, 3], world to camera, and centres [V, 3] in view 0's frame, at any scale.

    None where the pairs do not connect all views.
    """
    first = _along_tree(pairs, views)
    if first is None:
        return None
    R = _mean_rotations(pairs, first)
    return R, _centers(pairs, R)


def _along_tree(pairs: dict[tuple[int, int], Relative], views: int) -> Float64 | None:
    """Return rotations along a tree from view 0, the pairs with most inliers first."""
    R = {0: np.eye(3)}
    while len(R) < views:
        edges = [(pose.inliers, i, j) for (i, j), pose in pairs.items() if (i in R) != (j in R)]
        if not edges:
            return None
        _, i, j = max(edges)
        R.update({j: pairs[i, j].R @ R[i]} if i in R else {i: pairs[i, j].R.T @ R[j]})
    return np.stack([R[v] for v in range(views)])


def _mean_rotations(pairs: dict[tuple[int, int], Relative], first: Float64) -> Float64:
    i, j = np.array(list(pairs)).T
    measured = Rotation.from_matrix(np.stack([p.R for p in pairs.values()]))
    root = np.sqrt([p.inliers for p in pairs.values()])
    root = root / root.max()

    def rotations(x: Float64) -> Rotation:
        return Rotation.from_rotvec(np.concatenate([np.zeros((1, 3)), x.reshape(-1, 3)])) * Rotation.from_matrix(first)

    def residuals(x: Float64) -> Float64:
        R = rotations(x)
        return np.asarray(((measured.inv() * R[j] * R[i].inv()).as_rotvec() * root[:, None]).ravel())

    start = np.zeros(3 * (len(first) - 1))
    found = least_squares(residuals, start, loss="soft_l1", f_scale=_NEAR_RAD)
    return np.asarray(rotations(found.x).as_matrix())


def _centers(pairs: dict[tuple[int, int], Relative], R: Float64) -> Float64:
    """Return the centres whose differences are most parallel to the pairs' directions: the first at 0, of norm 1."""
    rows, ways = [], []
    for (i, j), pose in pairs.items():
        way = -R[j].T @ pose.t  # from centre i to centre j
        across = np.zeros((3, len(R), 3))
        cross = np.cross(way, np.eye(3)).T * np.sqrt(pose.inliers)
        across[:, j], across[:, i] = cross, -cross
        rows.append(across.reshape(3, -1)[:, 3:])
        ways.append((i, j, way, pose.inliers))
    *_, vt = np.linalg.svd(np.concatenate(rows))
    centers = np.concatenate([np.zeros((1, 3)), vt[-1].reshape(-1, 3)])
    ahead = sum(n * float(np.sign((centers[j] - centers[i]) @ way)) for i, j, way, n in ways)
    centers *= 1.0 if ahead >= 0 else -1.0
    return np.asarray(centers / np.sqrt((centers**2).sum(axis=1)[1:].mean()))
