"""How sensitivity varies over the chip of each camera, where no flat field says it: points that views share tell.

A camera c of relative sensitivity g_c shows a point of radiance L at pixel x as g_c(x) L. With log g_c a polynomial,

    log rate_c(x) = log L + B(x) a_c + rest

is linear: least squares over all points and cameras, with each point's log L eliminated, and weights that fall where
the rest is large (what moves, shines or is hidden). What all cameras have in common at a point is a texture of the
scene as well (docs/results/fixed_patterns.md): the mean of a over the cameras is 0. The mean of each g_c is 1.
Sensitivities that vary from pixel to pixel, and dark rates, stay in the rest.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.ndimage import map_coordinates, uniform_filter

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.scene.calibration import rates
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.starts.array_motion import deviation
from spike4dgs.method.starts.base import Start

ORDER = 4  # of the polynomials: 15 numbers a camera
_AROUND_PX = 3  # side of the square whose mean rate stands for a point: less of single pixels
_SEEN_BY = 3  # cameras at least
_LEAST_POINTS = 500
# Times the number of points: holds the polynomials where a part of a chip sees few of them, and leaves a camera's
# overall sensitivity free, which gradients that all cameras share would otherwise explain.
_RIDGE, _RIDGE_OF_MEAN = 1e-3, 1e-7
_ROUNDS = 8
_FAR = 2.0  # robust standard deviations of the rest, from which its weight falls
# The rest without shadings, in that with them, from which they are believed: 2 where sensitivity varies by 5 %.
_WORTH = 1.15
_LEAST_RATE = 1e-4  # spikes per tick, of pixels that hardly fire


def with_shadings(scene: TrainingScene, start: Start) -> TrainingScene:
    """Return a scene whose cameras' states have the shadings that the clip tells, and say so.

    It is `scene` itself where too few points tell, where shadings explain little, or where the array moves.
    """
    if start.path or len(scene.cameras) < _SEEN_BY:
        return scene
    logs = [np.log(uniform_filter(np.maximum(rates(s), _LEAST_RATE), _AROUND_PX)) for s in scene.streams]
    found = shadings(start.cameras, logs, start.points.astype(np.float64))
    if found is None:
        return scene
    spread = float(np.std(np.log(found)))
    print(f"sensitivity varies by {spread:.1%} over the chips, as points that views share tell", file=sys.stderr)
    shaded = zip(scene.cameras, found, strict=True)
    return replace(scene, states={**scene.states, **{c.id: replace(scene.state(c.id), shading=s) for c, s in shaded}})


def shadings(cameras: Sequence[Camera], logs: Sequence[Float64], points: Float64) -> Float32 | None:
    """Return each camera's relative sensitivity [C, H, W], smooth, with mean 1; None where the points tell none.

    `logs` are logarithms of rates [H, W] each, `points` [N, 3] of the world, most of them on surfaces that stand still.
    """
    height, width = logs[0].shape
    terms, seen = _sights(cameras, logs, points)
    used = np.isfinite(seen).sum(axis=0) >= _SEEN_BY
    if int(used.sum()) < _LEAST_POINTS:
        return None
    terms, seen = terms[:, :, used], seen[:, used]
    found, rest = _solve(terms, seen)
    _, without = _solve(terms[:, :1], seen)
    if not without > _WORTH * rest:
        return None
    v, u = np.mgrid[:height, :width] + 0.5
    maps = np.exp(np.einsum("ck,khw->chw", found, _terms(u / width, v / height)))
    return np.asarray(maps / maps.mean(axis=(1, 2), keepdims=True), np.float32)


def _sights(cameras: Sequence[Camera], logs: Sequence[Float64], points: Float64) -> tuple[Float64, Float64]:
    """Return the polynomials' terms [C, K, N] at each point in each camera, and logarithms of its rate there [C, N].

    NaN where a camera does not see the point's place.
    """
    terms, seen = [], []
    for camera, log in zip(cameras, logs, strict=True):
        uv, z = camera.project(points)
        inside = (z > 0) & (uv >= 1).all(axis=1) & (uv < [camera.width - 1, camera.height - 1]).all(axis=1)
        u, v = np.where(inside[:, None], uv, 1.0).T
        seen.append(np.where(inside, map_coordinates(log, [v - 0.5, u - 0.5], order=1), np.nan))
        terms.append(_terms(u / camera.width, v / camera.height))
    return np.stack(terms), np.stack(seen)


def _terms(x: Float64, y: Float64) -> Float64:
    """Return P_i(x) P_j(y) with i + j <= ORDER [K, ...] of places from 0 to 1, P the Legendre polynomials."""
    along, down = legvander(2 * x - 1, ORDER), legvander(2 * y - 1, ORDER)
    return np.stack([along[..., i] * down[..., j] for i in range(ORDER + 1) for j in range(ORDER + 1 - i)])


def _solve(terms: Float64, seen: Float64) -> tuple[Float64, float]:
    """Return the coefficients [C, K], with mean 0 over the cameras, and the robust spread of the rest."""
    cameras, k, points = terms.shape
    ok = np.isfinite(seen)
    weights = ok.astype(np.float64)
    found, rest = np.zeros((cameras, k)), 0.0
    ridge = points * np.tile([_RIDGE_OF_MEAN, *[_RIDGE] * (k - 1)], cameras)
    for _ in range(_ROUNDS):
        total = np.maximum(weights.sum(axis=0), 1e-9)
        left = _less_point(seen, weights)
        weighted = terms * weights[:, None]
        flat = weighted.reshape(cameras * k, points)
        normal = -(flat / total) @ flat.T + np.diag(ridge)
        for c in range(cameras):
            own = slice(c * k, (c + 1) * k)
            normal[own, own] += weighted[c] @ terms[c].T
        right = np.einsum("ckn,cn->ck", weighted, left)
        found = np.linalg.solve(normal, right.ravel()).reshape(cameras, k)
        found -= found.mean(axis=0)
        unexplained = _less_point(seen - np.einsum("ck,ckn->cn", found, terms), weights)
        rest = deviation(unexplained[ok])
        weights = ok / (1 + (np.where(ok, unexplained, 0) / (_FAR * rest)) ** 2) ** 2
    return found, rest


def _less_point(seen: Float64, weights: Float64) -> Float64:
    """Return logarithms [C, N] less the weighted mean of each point; 0 where it is not seen."""
    ok = np.isfinite(seen)
    known = np.where(ok, seen, 0.0)
    mean = (weights * known).sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-9)
    return np.where(ok, known - mean, 0.0)
