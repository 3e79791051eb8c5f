"""Bundle adjustment of an array from views of a board: intrinsics, camera poses and board poses of least error.

The unknowns are few (6 a board pose, up to 11 a camera), so the normal equations are added up detection by detection
from exact derivatives and solved densely, with Levenberg-Marquardt damping. Poses change by a small motion from the
left: X -> exp(w) X + v. The pose of the reference camera is constant, which fixes the frame; the board's size fixes the
scale. Square pixels; with `Freedom.distortion` also k1 and k2 of each lens (`benchmark.array.lens`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from spike4dgs.benchmark.arrays import Float64, Int64, Mask

_MOST_STEPS = 300  # where the board leaves much open, the way is long
_CONVERGED = 1e-9  # relative decrease of the sum of squares of a last step
_FINEST_PX = 1e-3  # the accuracy of corners is never better
_PER_CAMERA = 9  # w, v, focal length, principal point
_PER_LENS = 2  # k1, k2


@dataclass(frozen=True, eq=False)
class Detections:
    """S images in which the board was found: by which camera, in which view (a window that all cameras share)."""

    camera: Int64  # [S]
    view: Int64  # [S]
    uv: Float64  # [S, N, 2] px
    used: Mask  # [S, N] corners that count

    def of(self, chosen: Mask) -> Detections:
        """Return a selection, [S] bool."""
        return Detections(self.camera[chosen], self.view[chosen], self.uv[chosen], self.used[chosen])


@dataclass(frozen=True, eq=False)
class Rig:
    """C cameras and T board poses, OpenCV axes: x_cam = R x + t, x = board_R x_board + board_t."""

    focal: Float64  # [C] px
    principal: Float64  # [C, 2] principal points, px
    R: Float64  # [C, 3, 3]
    t: Float64  # [C, 3]
    board_R: Float64  # [T, 3, 3]
    board_t: Float64  # [T, 3]
    lens: Float64 | None = None  # [C, 2] k1, k2; None: pinholes

    def residuals(self, s: Detections, points: Float64) -> Float64:
        """Return the projections of the board's points [N, 3] minus the detected corners [S, N, 2], px."""
        turned, world = self.turned(s, points)
        x = turned + self.t[s.camera][:, None]
        f = self.focal[s.camera][:, None, None]
        seen = f * x[..., :2] / x[..., 2:]
        if self.lens is not None:
            square = np.sum((x[..., :2] / x[..., 2:]) ** 2, axis=-1)
            seen = seen * self.radial(s, square)[0][..., None]
        return np.asarray(seen + self.principal[s.camera][:, None] - s.uv)

    def radial(self, s: Detections, square: Float64) -> tuple[Float64, Float64]:
        """Return 1 + k1 r^2 + k2 r^4 and its derivative in r^2, [S, N] each, of squares r^2 [S, N]."""
        if self.lens is None:
            return np.ones_like(square), np.zeros_like(square)
        k1, k2 = (self.lens[s.camera, i][:, None] for i in range(_PER_LENS))
        return 1 + square * (k1 + square * k2), k1 + 2 * k2 * square

    def turned(self, s: Detections, points: Float64) -> tuple[Float64, Float64]:
        """Return the points in the cameras' frames but for t [S, N, 3], and in the world [S, N, 3]."""
        world = points @ self.board_R[s.view].transpose(0, 2, 1) + self.board_t[s.view][:, None]
        return world @ self.R[s.camera].transpose(0, 2, 1), world


@dataclass(frozen=True)
class Freedom:
    """The unknown intrinsics.

    Attributes:
        shared_focal: Estimate one focal length for all cameras.
        centered: Keep the principal points in the middle of the image.
        distortion: Estimate k1 and k2 of every lens. The board must reach the corners of the images.
    """

    shared_focal: bool = False
    centered: bool = False
    distortion: bool = False


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The result of `adjust`. Standard deviations are from the normal equations, relative to the reference camera."""

    rig: Rig
    sigma_px: float  # of a coordinate of a corner
    center_m: Float64  # [C] of a camera's centre, root of the sum over its axes
    turn_deg: Float64  # [C] of its rotation, likewise
    focal_px: Float64  # [C]
    lens: Float64 | None = None  # [C, 2, 2] covariance of k1 and k2; None: pinholes


def adjust(
    rig: Rig, detections: Detections, points: Float64, reference: int, freedom: Freedom | None = None
) -> Adjusted:
    """Minimise the squares from an initial rig near the solution. `points` [N, 3]: the board's corners."""
    freedom = freedom or Freedom()
    columns = _columns(len(rig.focal), len(rig.board_t), reference, freedom)
    if freedom.distortion and rig.lens is None:
        rig = replace(rig, lens=np.zeros((len(rig.focal), _PER_LENS)))
    if freedom.shared_focal:  # all take the same steps, and so begin alike
        rig = replace(rig, focal=np.full_like(rig.focal, rig.focal.mean()))
    damping = 1e-3
    cost, H, g = _normal(rig, detections, points, columns)
    for _ in range(_MOST_STEPS):
        own = np.diag(H)  # 0 of a view or a camera whose corners are all left out: it stays where it is
        step = np.asarray(np.linalg.solve(H + damping * np.diag(np.where(own > 0, own, 1.0)), -g), np.float64)
        moved = _moved(rig, step, columns)
        new, new_H, new_g = _normal(moved, detections, points, columns)
        if not new < cost:
            if damping > 1e8:
                break
            damping *= 10
            continue
        converged = cost - new <= _CONVERGED * cost
        rig, cost, H, g, damping = moved, new, new_H, new_g, damping / 5
        if converged:
            break
    variance = max(cost / max(2 * int(detections.used.sum()) - columns.n, 1), _FINEST_PX**2)
    covariance = variance * _inverse(H)
    at = columns.camera[:, _PER_CAMERA:]
    lens = covariance[at[:, :, None], at[:, None]] if freedom.distortion else None
    return Adjusted(rig, math.sqrt(variance), *_deviations(np.diag(covariance), columns), lens)


def trimmed(rig: Rig, detections: Detections, points: Float64, sigmas: float = 4.0) -> Detections:
    """Return the detections without corners that are off by more than `sigmas` robust standard deviations."""
    errors = np.linalg.norm(rig.residuals(detections, points), axis=-1)
    sigma = float(np.median(errors)) / math.sqrt(2 * math.log(2))  # Rayleigh's median is 1.18 sigma
    return replace(detections, used=errors <= sigmas * max(sigma, _FINEST_PX))


def rms_px(rig: Rig, detections: Detections, points: Float64) -> float:
    """Return the reprojection error: root mean square distance of the used corners; NaN without any."""
    errors = rig.residuals(detections, points)[detections.used]
    if not len(errors):
        return math.nan
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1))))


# ------------------------------------------------------------ columns of the unknowns


@dataclass(frozen=True, eq=False)
class _Columns:
    camera: Int64  # [C, 9 or 11] column of w, v, focal length, principal point, lens; -1 where it is known
    board: Int64  # [T, 6] columns of w, v
    n: int


def _columns(n_cameras: int, n_views: int, reference: int, freedom: Freedom) -> _Columns:
    unknown = np.ones((n_cameras, _PER_CAMERA + freedom.distortion * _PER_LENS), bool)
    unknown[reference, :6] = False
    if freedom.shared_focal:
        unknown[:, 6] = np.arange(n_cameras) == 0
    if freedom.centered:
        unknown[:, 7:9] = False
    camera = np.where(unknown, np.cumsum(unknown).reshape(unknown.shape) - 1, -1)
    if freedom.shared_focal:
        camera[:, 6] = camera[0, 6]
    board = int(unknown.sum()) + np.arange(6 * n_views).reshape(n_views, 6)
    return _Columns(camera, board, int(unknown.sum()) + 6 * n_views)


def _normal(rig: Rig, detections: Detections, points: Float64, columns: _Columns) -> tuple[float, Float64, Float64]:
    """Return the sum of squares, J^T J [P, P] and J^T r [P]."""
    r, J = _linearised(rig, detections, points)
    at = np.concatenate([columns.camera[detections.camera], columns.board[detections.view]], axis=1)  # [S, 15 or 17]
    at = np.where(at >= 0, at, columns.n)  # known values go to a row and column that are dropped
    H, g = np.zeros((columns.n + 1, columns.n + 1)), np.zeros(columns.n + 1)
    np.add.at(H, (at[:, :, None], at[:, None, :]), J.transpose(0, 2, 1) @ J)
    np.add.at(g, at, (J.transpose(0, 2, 1) @ r[..., None])[..., 0])
    return float(np.sum(r * r)), H[:-1, :-1], g[:-1]


def _linearised(rig: Rig, s: Detections, points: Float64) -> tuple[Float64, Float64]:
    """Return residuals [S, 2 N], 0 for unused corners, and derivatives [S, 2 N, 9 or 11 + 6]: by camera, by board."""
    turned, world = rig.turned(s, points)
    x = turned + rig.t[s.camera][:, None]
    f = rig.focal[s.camera][:, None]
    a, b, inverse = x[..., 0] / x[..., 2], x[..., 1] / x[..., 2], f / x[..., 2]
    square = a * a + b * b
    radial, slope = rig.radial(s, square)
    aa, ab, bb = radial + 2 * slope * a * a, 2 * slope * a * b, radial + 2 * slope * b * b  # d (u, v) / d (a, b) / f
    seen = np.zeros((*a.shape, 2, 3))  # d (u, v) / d x
    seen[..., 0, 0], seen[..., 1, 1] = aa * inverse, bb * inverse
    if rig.lens is not None:
        seen[..., 0, 1] = seen[..., 1, 0] = ab * inverse
    seen[..., 0, 2], seen[..., 1, 2] = -(aa * a + ab * b) * inverse, -(ab * a + bb * b) * inverse
    by_board = seen @ rig.R[s.camera][:, None]
    own = _PER_CAMERA + (_PER_LENS if rig.lens is not None else 0)
    J = np.empty((*a.shape, 2, own + 6))
    J[..., 0:3], J[..., 3:6] = -seen @ _cross(x), seen
    J[..., 0, 6], J[..., 1, 6] = a * radial, b * radial
    J[..., 7:9] = np.eye(2)
    for k, power in enumerate((square, square * square)[: own - _PER_CAMERA]):
        J[..., 0, 9 + k], J[..., 1, 9 + k] = f * a * power, f * b * power
    J[..., own : own + 3], J[..., own + 3 :] = -by_board @ _cross(world), by_board
    r = np.stack([f * a * radial, f * b * radial], -1) + rig.principal[s.camera][:, None] - s.uv
    counts = s.used[..., None]
    return np.where(counts, r, 0).reshape(len(r), -1), np.where(counts[..., None], J, 0).reshape(
        len(r), -1, J.shape[-1]
    )


def _cross(v: Float64) -> Float64:
    """Return matrices [..., 3, 3] with [v]x w = v x w."""
    m = np.zeros((*v.shape, 3))
    m[..., 2, 1], m[..., 0, 2], m[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return m - np.swapaxes(m, -1, -2)


def _moved(rig: Rig, step: Float64, columns: _Columns) -> Rig:
    camera = np.where(columns.camera >= 0, step[columns.camera], 0.0)
    board = step[columns.board]
    R, t = _nudged(rig.R, rig.t, camera[:, :6])
    board_R, board_t = _nudged(rig.board_R, rig.board_t, board)
    lens = None if rig.lens is None else rig.lens + camera[:, 9:]
    return Rig(rig.focal + camera[:, 6], rig.principal + camera[:, 7:9], R, t, board_R, board_t, lens)


def _nudged(R: Float64, t: Float64, motion: Float64) -> tuple[Float64, Float64]:
    """Return poses [n] after small motions [n, 6] from the left."""
    turn = Rotation.from_rotvec(motion[:, :3]).as_matrix()
    return turn @ R, np.einsum("nij,nj->ni", turn, t) + motion[:, 3:]


def _inverse(H: Float64) -> Float64:
    """Return the inverse [P, P] of a normal matrix: very large where the data determine nothing.

    Its units differ, metres from pixels by orders of magnitude, so its eigenvalues compare only at a unit diagonal.
    """
    own = np.diag(H)
    scale = 1 / np.sqrt(np.where(own > 0, own, 1.0))
    values, vectors = np.linalg.eigh(H * np.outer(scale, scale))
    unit = (vectors / np.maximum(values, np.finfo(float).eps)) @ vectors.T
    return np.asarray(unit * np.outer(scale, scale), np.float64)


def _deviations(variances: Float64, columns: _Columns) -> tuple[Float64, Float64, Float64]:
    """Return standard deviations of centres (-R^T v, as far as v moves them), rotations in degrees, and focal lengths.

    They are 0 for known values.
    """
    variance = np.where(columns.camera >= 0, variances[columns.camera], 0.0)
    turn, center = np.sqrt(variance[:, :3].sum(axis=1)), np.sqrt(variance[:, 3:6].sum(axis=1))
    return center, np.degrees(turn), np.sqrt(variance[:, 6])
