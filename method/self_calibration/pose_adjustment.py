"""Bundle adjustment of an array that starts from given poses and stays near them.

Unknown are a small turn and shift of every camera, and the points. The given poses are knowledge, with standard
deviations: they hold the frame and the scale, which no image tells, and what a narrow array tells badly. Observations
count by Cauchy's weights, because some matches are wrong. Points are eliminated from the normal equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from spike4dgs.benchmark.arrays import Float32, Float64, Int64
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.starts.matched_poses import Seen, read_matches
from spike4dgs.method.starts.plane_sweep import widest_baseline
from spike4dgs.method.starts.structure_from_motion import FEATURES, FeatureSettings, find_features


@dataclass(frozen=True, eq=False)
class Tracks:
    """N observations of P points; every point is seen by two or more cameras, and once by each."""

    camera: Int64  # [N]
    point: Int64  # [N]
    uv: Float64  # [N, 2] px

    @property
    def points(self) -> int:
        """P."""
        return int(self.point.max()) + 1 if len(self.point) else 0


def find_tracks(cameras: Sequence[Camera], images: Float32, seed: int, features: FeatureSettings = FEATURES) -> Tracks:
    """Return the tracks through images of all views [C, H, W], linear radiance. The same seed gives the same tracks."""
    with find_features(cameras, images, seed, features) as found:
        return joined(read_matches(found, features.enlarge))


def joined(seen: Seen) -> Tracks:
    """Return the tracks that pairs of matches make; one that has two features of a view is wrong, and left out."""
    starts = np.concatenate([[0], np.cumsum([len(p) for p in seen.pixels])])
    parent = np.arange(starts[-1])

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = int(parent[i])
        return i

    for (a, b), matches in seen.same.items():
        for i, j in matches:
            parent[root(int(starts[a] + i))] = root(int(starts[b] + j))
    roots = np.array([root(i) for i in range(len(parent))], np.int64)
    view = np.repeat(np.arange(len(seen.pixels)), np.diff(starts))
    _, point, count = np.unique(roots, return_inverse=True, return_counts=True)
    point = point.reshape(-1)
    twice = np.unique(np.column_stack([point, view]), axis=0, return_counts=True)
    wrong = np.isin(point, twice[0][twice[1] > 1][:, 0])
    kept = (count[point] >= 2) & ~wrong
    _, renumbered = np.unique(point[kept], return_inverse=True)
    uv = np.concatenate(seen.pixels)[kept] if len(parent) else np.zeros((0, 2))
    return Tracks(view[kept], renumbered.reshape(-1), uv)


POSE = 6  # a camera's unknowns: turn in its own frame, rad; shift of its centre in the world's, m


@dataclass(frozen=True)
class AdjustSettings:
    """Numbers of the adjustment."""

    turn_deg: float = 1.0  # standard deviation of a given rotation, about each axis
    shift: float = 0.02  # of a given centre, along each axis, in largest distances between cameras
    noise_px: float = 0.3  # of a feature
    scales_px: tuple[float, ...] = (4.0, 1.0)  # of Cauchy's weights, one after the other
    steps: int = 20  # for each scale, at most
    converged: float = 1e-6  # relative decrease of the cost of a last step


@dataclass(frozen=True, eq=False)
class Adjusted:
    """Cameras, points [P, 3], and the distance of every observation from its point's projection [N], px."""

    cameras: tuple[Camera, ...]
    points: Float64
    errors: Float64


def adjust(
    cameras: Sequence[Camera], tracks: Tracks, s: AdjustSettings, free: Sequence[bool] | None = None
) -> Adjusted:
    """Return cameras and points that fit the tracks; only cameras that are `free` (all by default) move."""
    moves = np.ones(len(cameras), bool) if free is None else np.asarray(free, bool)
    state = _State(tuple(cameras), triangulated(cameras, tracks), np.zeros((len(cameras), POSE)))
    for scale in s.scales_px:
        state = _descended(state, tracks, s, moves, scale)
    return Adjusted(state.cameras, state.points, np.linalg.norm(_residuals(state, tracks), axis=1))


def triangulated(cameras: Sequence[Camera], tracks: Tracks) -> Float64:
    """Return the points [P, 3] nearest to the rays of their observations, and in front of the cameras."""
    centers = np.stack([c.center for c in cameras])
    rays = np.concatenate([tracks.uv, np.ones((len(tracks.uv), 1))], axis=1)
    to_world = np.stack([c.R.T @ np.linalg.inv(c.K) for c in cameras])
    rays = np.einsum("nij,nj->ni", to_world[tracks.camera], rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    A, b = np.zeros((tracks.points, 3, 3)), np.zeros((tracks.points, 3))
    np.add.at(A, tracks.point, across)
    np.add.at(b, tracks.point, np.einsum("nij,nj->ni", across, centers[tracks.camera]))
    # Nearly parallel rays meet anywhere: a little weight draws the point to the rays' far end.
    size = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    far = np.zeros((tracks.points, 3))
    np.add.at(far, tracks.point, rays)
    far = centers.mean(axis=0) + 1e3 * size * far / np.maximum(np.linalg.norm(far, axis=1, keepdims=True), 1e-12)
    weight = 1e-9
    return np.asarray(np.linalg.solve(A + weight * np.eye(3), (b + weight * far)[..., None])[..., 0])


@dataclass(frozen=True, eq=False)
class _State:
    cameras: tuple[Camera, ...]
    points: Float64
    moved: Float64  # [C, 6] from the given poses, to first order


def _residuals(state: _State, tracks: Tracks) -> Float64:
    """Return projections minus observations [N, 2]; far off for a point behind its camera."""
    x = _in_cameras(state, tracks)
    K = np.stack([c.K for c in state.cameras])[tracks.camera]
    z = np.where(x[:, 2] > 1e-9, x[:, 2], np.nan)
    uv = np.stack([K[:, 0, 0] * x[:, 0] / z + K[:, 0, 2], K[:, 1, 1] * x[:, 1] / z + K[:, 1, 2]], axis=1)
    return np.nan_to_num(uv - tracks.uv, nan=1e3)


def _in_cameras(state: _State, tracks: Tracks) -> Float64:
    R, t = (np.stack([getattr(c, name) for c in state.cameras])[tracks.camera] for name in "Rt")
    return np.asarray(np.einsum("nij,nj->ni", R, state.points[tracks.point]) + t)


def _descended(state: _State, tracks: Tracks, s: AdjustSettings, moves: NDArray[np.bool_], scale: float) -> _State:
    """Return the state after Levenberg-Marquardt with weights of one scale."""
    sigma = np.repeat([np.radians(s.turn_deg), max(s.shift * widest_baseline(state.cameras), 1e-9)], 3)
    prior = 1 / sigma**2  # weights of a camera's six unknowns
    damping, cost = 1e-3, _cost(state, tracks, s, prior, scale)
    for _ in range(s.steps):
        new = _stepped(state, tracks, s, moves, prior, scale, damping)
        new_cost = _cost(new, tracks, s, prior, scale)
        if new_cost >= cost:
            damping *= 10
            if damping > 1e6:
                break
            continue
        done = cost - new_cost < s.converged * cost
        state, cost, damping = new, new_cost, max(damping / 5, 1e-9)
        if done:
            break
    return state


def _cost(state: _State, tracks: Tracks, s: AdjustSettings, prior: Float64, scale: float) -> float:
    square = (_residuals(state, tracks) ** 2).sum(axis=1)
    return float((scale / s.noise_px) ** 2 * np.log1p(square / scale**2).sum() + (prior * state.moved**2).sum())


def _stepped(
    state: _State,
    tracks: Tracks,
    s: AdjustSettings,
    moves: NDArray[np.bool_],
    prior: Float64,
    scale: float,
    damping: float,
) -> _State:
    """Return the state after one damped step of Gauss-Newton."""
    r = _residuals(state, tracks)
    by_pose, by_point = _slopes(state, tracks)
    by_pose = by_pose * moves[tracks.camera][:, None, None]
    weight = 1 / (1 + (r**2).sum(axis=1) / scale**2) / s.noise_px**2
    cameras, points = len(state.cameras), len(state.points)
    H, g = np.zeros((cameras, POSE, POSE)), np.zeros((cameras, POSE))
    own, own_g = np.zeros((points, 3, 3)), np.zeros((points, 3))
    cross = np.zeros((points, cameras, POSE, 3))
    weighted, weighted_point = weight[:, None, None] * by_pose, weight[:, None, None] * by_point
    np.add.at(H, tracks.camera, weighted.transpose(0, 2, 1) @ by_pose)
    np.add.at(g, tracks.camera, np.einsum("nip,ni->np", weighted, r))
    np.add.at(own, tracks.point, weighted_point.transpose(0, 2, 1) @ by_point)
    np.add.at(own_g, tracks.point, np.einsum("nip,ni->np", weighted_point, r))
    np.add.at(cross, (tracks.point, tracks.camera), weighted.transpose(0, 2, 1) @ by_point)
    own = own + damping * own * np.eye(3) + 1e-12 * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    full = np.zeros((cameras * POSE, cameras * POSE))
    for c in range(cameras):
        block = H[c] + np.diag(prior)
        full[c * POSE : (c + 1) * POSE, c * POSE : (c + 1) * POSE] = block + damping * np.diag(np.diag(block))
    gradient = (g + prior * state.moved).ravel()
    flat = cross.reshape(points, cameras * POSE, 3)
    gain = np.linalg.solve(own, flat.transpose(0, 2, 1))  # [P, 3, C * 6]
    reduced = full - flat.transpose(0, 2, 1).reshape(-1, cameras * POSE).T @ gain.reshape(-1, cameras * POSE)
    step = -np.linalg.solve(reduced, gradient - np.einsum("pax,pa->x", gain, own_g))
    step = np.where(np.repeat(moves, POSE), step, 0.0)
    point_step = -np.linalg.solve(own, (own_g + np.einsum("pxa,x->pa", flat, step))[..., None])[..., 0]
    poses = step.reshape(cameras, POSE)
    moved = tuple(_moved(c, p) for c, p in zip(state.cameras, poses, strict=True))
    return _State(moved, state.points + point_step, state.moved + poses)


def _slopes(state: _State, tracks: Tracks) -> tuple[Float64, Float64]:
    """Return the derivatives of projections by poses [N, 2, 6] and by points [N, 2, 3]."""
    x = _in_cameras(state, tracks)
    K, R = (np.stack([getattr(c, name) for c in state.cameras])[tracks.camera] for name in "KR")
    z = np.where(x[:, 2] > 1e-9, x[:, 2], 1e9)
    pinhole = np.zeros((len(x), 2, 3))
    pinhole[:, 0, 0], pinhole[:, 1, 1] = K[:, 0, 0] / z, K[:, 1, 1] / z
    pinhole[:, :, 2] = -np.stack([K[:, 0, 0] * x[:, 0], K[:, 1, 1] * x[:, 1]], axis=1) / (z * z)[:, None]
    by_point = pinhole @ R
    return np.concatenate([np.cross(x[:, None], pinhole), -by_point], axis=2), by_point


def _moved(camera: Camera, step: Float64) -> Camera:
    """Return a camera turned in its own frame by a rotation vector, its centre shifted."""
    R = Rotation.from_rotvec(step[:3]).as_matrix() @ camera.R
    return replace(camera, R=R, t=-R @ (camera.center + step[3:])) if step.any() else camera
