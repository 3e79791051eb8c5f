"""Bundle adjustment of views and points: poses by SciPy's least squares, each point's depth eliminated.

A point is its pixel in its anchor view and an inverse depth w along that pixel's ray d. View j sees it at the
projection of

    p = R_j (R_r^T d + w (c_r - c_j)),

so at given poses its best w is a problem of one number, solved by a few Newton steps, and the derivative of the
residuals with respect to the poses is what the projection off the derivative with respect to w leaves (variable
projection, Golub and Pereyra 1973, in Kaufman's form). Sights are weighted by their expected errors, and again by a
Cauchy loss between the rounds: matches may be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.method.matching.tracks import Tracks

_GAUGE = 100.0  # weight of the scale's equation
_BEHIND = 1e-6  # of a depth relative to the point's: smaller ones are cut
_NEWTON = 3
_CAUCHY = 2.0  # expected errors beyond which a sight loses weight


@dataclass(frozen=True, eq=False)
class Array:
    """Poses of V views in view 0's frame and their intrinsics."""

    R: Float64  # [V, 3, 3] world to camera
    centers: Float64  # [V, 3] the first at 0; the root of the others' mean square is 1
    K: Float64  # [V, 3, 3]

    def moved(self, x: Float64) -> Array:
        """Return the array after steps `x`: rotation and centre of each view but the first, then ln of the focal."""
        n = len(self.R) - 1
        steps = x[: 6 * n].reshape(n, 6)
        R = self.R.copy()
        R[1:] = Rotation.from_rotvec(steps[:, :3]).as_matrix() @ R[1:]
        centers = self.centers.copy()
        centers[1:] += steps[:, 3:]
        K = self.K.copy()
        if len(x) > 6 * n:
            K[:, [0, 1], [0, 1]] *= np.exp(x[-1])
        return Array(R, centers, K)


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The result of an adjustment."""

    array: Array
    inverse_depth: Float64  # [N] of the tracks, along the optical axis of their anchors
    errors: Float64  # [M] distance of each sight from where its point should be, in expected errors
    cost: float  # mean of ln(1 + (error / cauchy)^2) over the sights: the same matches' least is best


@dataclass(frozen=True, eq=False)
class _Linear:
    """Sights of an array at given inverse depths."""

    p: Float64  # [M, 3]
    toward: Float64  # [M, 3] dp / dw
    ray: Float64  # [M, 3] d of the sight's point
    offset: Float64  # [M, 2] where it is seen, less where it should be, in weighted errors
    slope: Float64  # [M, 2, 3] d offset / dp


def adjust(array: Array, tracks: Tracks, *, focal: bool = False, rounds: int = 4) -> Adjusted:
    """Return the array that explains the tracks best, from a first one; with `focal` all views' focal length too."""
    weights = _weights_at(array, tracks)
    for _ in range(rounds):
        array, w = _one_round(array, tracks, weights, focal)
        errors = np.linalg.norm(_sights(array, tracks, w, np.ones_like(weights)).offset, axis=1)
        weights = _cauchy(errors)
    if np.median(w) < 0:  # centres and depths may change their signs together, and nothing else changes
        array, w = replace(array, centers=-array.centers), -w
    return Adjusted(array, w, errors, float(np.log1p((errors / _CAUCHY) ** 2).mean()))


def _weights_at(array: Array, tracks: Tracks) -> Float64:
    """Return weights of the sights [M] at first poses: by their errors from depths on which most sights agree."""
    weights = np.ones(len(tracks.track))
    for _ in range(3):
        w = depths(array, tracks, weights)
        weights = _cauchy(np.linalg.norm(_sights(array, tracks, w, np.ones_like(weights)).offset, axis=1))
    return weights


def _cauchy(errors: Float64) -> Float64:
    """Return the weights of errors under a Cauchy loss, as wide as half of the errors ask for."""
    wide = max(_CAUCHY, float(np.median(errors)))
    return np.asarray(1 / (1 + (errors / wide) ** 2))


def _one_round(array: Array, tracks: Tracks, weights: Float64, focal: bool) -> tuple[Array, Float64]:
    unknowns = 6 * (len(array.R) - 1) + focal
    kept: dict[str, Any] = {}

    def at(x: Float64) -> tuple[Array, Float64, _Linear]:
        if "x" not in kept or not np.array_equal(kept["x"], x):
            here = array.moved(x)
            w = depths(here, tracks, weights)
            kept.update(x=x.copy(), found=(here, w, _sights(here, tracks, w, weights)))
        found: tuple[Array, Float64, _Linear] = kept["found"]
        return found

    def residuals(x: Float64) -> Float64:
        here, _, sights = at(x)
        return np.append(sights.offset.ravel(), _GAUGE * ((here.centers**2).sum() / (len(here.R) - 1) - 1))

    def jacobian(x: Float64) -> Float64:
        here, w, sights = at(x)
        return np.concatenate([_projected(here, tracks, w, sights, x, focal), _gauge_row(here, unknowns)])

    found = least_squares(residuals, np.zeros(unknowns), jacobian, method="lm", max_nfev=12)
    here, w, _ = at(found.x)
    return here, w


def depths(array: Array, tracks: Tracks, weights: Float64) -> Float64:
    """Return each track's best inverse depth [N]: the linear one, then Newton's steps on the pixels' distances."""
    still = _sights(array, tracks, np.zeros(len(tracks.anchor)), weights)
    K = array.K[tracks.view]
    y = (tracks.uv - K[:, :2, 2]) / K[:, [0, 1], [0, 1]]
    # p x (y, 1) = 0 is linear in w; the errors' weights are those of the sights
    a = still.p[:, :2] - y * still.p[:, 2:]
    b = still.toward[:, :2] - y * still.toward[:, 2:]
    scale = (np.sqrt(weights) / tracks.error)[:, None]
    w = -_per_track(tracks, (a * b * scale**2).sum(axis=1)) / _positive(_per_track(tracks, ((b * scale) ** 2).sum(1)))
    for _ in range(_NEWTON):
        sights = _sights(array, tracks, w, weights)
        slope = np.einsum("mij,mj->mi", sights.slope, sights.toward)
        step = _per_track(tracks, (slope * sights.offset).sum(1)) / _positive(_per_track(tracks, (slope**2).sum(1)))
        w = w - step
    return np.asarray(w)


def _per_track(tracks: Tracks, values: Float64) -> Float64:
    return np.asarray(np.bincount(tracks.track, weights=values, minlength=len(tracks.anchor)), np.float64)


def _positive(x: Float64) -> Float64:
    return np.maximum(x, 1e-30)


def _sights(array: Array, tracks: Tracks, w: Float64, weights: Float64) -> _Linear:
    r, j = tracks.anchor[tracks.track], tracks.view
    K = array.K[tracks.anchor]
    d = np.concatenate([(tracks.at - K[:, :2, 2]) / K[:, [0, 1], [0, 1]], np.ones((len(tracks.at), 1))], axis=1)
    d = d[tracks.track]
    world = np.einsum("mji,mj->mi", array.R[r], d)
    baseline = array.centers[r] - array.centers[j]
    toward = np.einsum("mij,mj->mi", array.R[j], baseline)
    p = np.einsum("mij,mj->mi", array.R[j], world) + w[tracks.track][:, None] * toward
    z = np.where(np.abs(p[:, 2]) < _BEHIND, _BEHIND, p[:, 2])
    f = array.K[j][:, [0, 1], [0, 1]]
    scale = (np.sqrt(weights) / tracks.error)[:, None]
    offset = (f * p[:, :2] / z[:, None] + array.K[j][:, :2, 2] - tracks.uv) * scale
    slope = np.zeros((len(p), 2, 3))
    slope[:, [0, 1], [0, 1]] = f / z[:, None]
    slope[:, :, 2] = -f * p[:, :2] / z[:, None] ** 2
    return _Linear(p, toward, d, offset, slope * scale[:, :, None])


def _projected(array: Array, tracks: Tracks, w: Float64, sights: _Linear, x: Float64, focal: bool) -> Float64:
    """Return the derivative [2 M, unknowns] of the offsets at the best depths."""
    r, j = tracks.anchor[tracks.track], tracks.view
    m, n = len(j), len(array.R) - 1
    full = np.zeros((m, 2, 6 * (n + 1) + focal))
    rows = np.arange(m)
    Rj = array.R[j]
    steps = np.concatenate([np.zeros((1, 3)), x[: 6 * n].reshape(n, 6)[:, :3]])
    bend = np.stack([_left_jacobian(step) for step in steps])
    inverse = w[tracks.track][:, None, None]
    parts = {  # view -> derivative of p by its rotation and its centre, [M, 3, 3] each
        "j": (-_cross(sights.p) @ bend[j], -inverse * Rj),
        "r": (Rj @ array.R[r].transpose(0, 2, 1) @ _cross(sights.ray) @ bend[r], inverse * Rj),
    }
    for who, view in (("j", j), ("r", r)):
        for k, part in enumerate(parts[who]):
            columns = 6 * view[:, None] + 3 * k + np.arange(3)
            full[rows[:, None, None], np.arange(2)[None, :, None], columns[:, None]] += sights.slope @ part
    if focal:
        turned = Rj @ array.R[r].transpose(0, 2, 1)
        by_ray = np.einsum("mij,mj->mi", turned[:, :, :2], -sights.ray[:, :2])
        seen = sights.slope[:, [0, 1], [0, 1]] * sights.p[:, :2]  # f x / z, weighted
        full[:, :, -1] = np.einsum("mij,mj->mi", sights.slope, by_ray) + seen
    free = full[:, :, 6:]
    along = np.einsum("mij,mj->mi", sights.slope, sights.toward)  # d offset / dw [M, 2]
    square = _positive(_per_track(tracks, (along**2).sum(axis=1)))
    share = np.zeros((len(tracks.anchor), free.shape[2]))
    np.add.at(share, tracks.track, np.einsum("mi,miu->mu", along, free))
    free = free - along[:, :, None] * (share / square[:, None])[tracks.track][:, None]
    return np.asarray(free.reshape(2 * m, -1))


def _gauge_row(array: Array, unknowns: int) -> Float64:
    row = np.zeros((1, unknowns))
    n = len(array.R) - 1
    row[0, : 6 * n].reshape(n, 6)[:, 3:] = 2 * _GAUGE * array.centers[1:] / n
    return row


def _cross(v: Float64) -> Float64:
    """Return the matrices [M, 3, 3] of v x."""
    m = np.zeros((len(v), 3, 3))
    m[:, 0, 1], m[:, 0, 2], m[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return m - m.transpose(0, 2, 1)


def _left_jacobian(step: Float64) -> Float64:
    """Return J with exp(step + e) = exp(J e) exp(step) to first order in e."""
    angle = float(np.linalg.norm(step))
    S = _cross(step[None])[0]
    if angle < 1e-6:
        return np.asarray(np.eye(3) + S / 2)
    a, b = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + a * S + b * S @ S)
