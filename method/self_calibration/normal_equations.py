"""Least squares of a few numbers of each camera over many patches, whose radiance and depth are eliminated.

The radiance that camera c sees at point k of patch p is, but for noise, a number m of the point alone:

    v_pkc + a_pkc . d_c + h_pkc . e_p = m_pk

with d_c the change of the camera's numbers, e_p that of the patch's surface (its inverse depth and slants). m and e
appear in one patch only and are eliminated in closed form, so that what is solved has as many unknowns as the cameras
have numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float64


@dataclass(frozen=True, eq=False)
class Reduced:
    """The normal equations H d = -g of the cameras' numbers [C * Q], and what gives the surfaces back."""

    H: Float64  # [C * Q, C * Q]
    g: Float64  # [C * Q]
    cross: Float64  # [P, M, C * Q]
    own_H: Float64  # [P, M, M]
    own_g: Float64  # [P, M]

    def surface_steps(self, step: Float64) -> Float64:
        """Return the changes of the patches' surfaces [P, M] that go with a step of the cameras."""
        return np.asarray(-np.linalg.solve(self.own_H, (self.own_g + self.cross @ step)[..., None])[..., 0], np.float64)


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of the surfaces before: the weight of each of their numbers [M], and its gradient now [P, M]."""

    weight: Float64
    gradient: Float64


def residuals(value: Float64, weight: Float64) -> Float64:
    """Return values [..., C] minus their weighted mean over cameras, the best m; 0 where the weight is 0."""
    total = np.maximum(weight.sum(axis=-1, keepdims=True), 1e-300)
    mean = (weight * value).sum(axis=-1, keepdims=True) / total
    return np.where(weight > 0, value - mean, 0.0)


def reduce(value: Float64, by_surface: Float64, by_numbers: Float64, weight: Float64, prior: Prior) -> Reduced:
    """Return the reduced normal equations of values v [P, K, C] with derivatives h [P, K, C, M] and a [P, K, C, Q].

    weight [P, K, C] is 0 where a camera says nothing, and all values there are finite.
    """
    patches, points, cameras, q = by_numbers.shape
    total = np.maximum(weight.sum(axis=-1), 1e-300)  # [P, K]
    r = residuals(value, weight)
    h = residuals(np.moveaxis(by_surface, -1, 0), weight)  # [M, P, K, C]
    weighted = weight[..., None] * by_numbers  # [P, K, C, Q]
    flat = weighted.reshape(patches * points, cameras * q)
    H = -(flat / total.reshape(-1, 1)).T @ flat
    for c in range(cameras):
        a = by_numbers[:, :, c].reshape(-1, q)
        H[c * q : (c + 1) * q, c * q : (c + 1) * q] += weighted[:, :, c].reshape(-1, q).T @ a
    g = (weighted * r[..., None]).sum(axis=(0, 1)).ravel()
    cross = np.stack([(weighted * x[..., None]).sum(axis=1).reshape(patches, cameras * q) for x in h], axis=1)
    own_H = np.stack([(weight * x * h).sum(axis=(2, 3)) for x in h]).transpose(2, 0, 1) + np.diag(prior.weight)
    own_g = (weight * r * h).sum(axis=(2, 3)).T + prior.gradient
    gain = np.linalg.solve(own_H, cross)  # [P, M, C * Q]
    H -= cross.reshape(-1, cameras * q).T @ gain.reshape(-1, cameras * q)
    g -= np.einsum("pmx,pm->x", gain, own_g)
    return Reduced(H, g, cross, own_H, own_g)
