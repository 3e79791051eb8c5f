"""Terms that keep tracked Gaussians together: those of Dynamic 3D Gaussians (Luiten et al. 2024) beside its image loss.

With x_i, q_i the centres and unit quaternions at the tracked time, x'_i, q'_i those at the time before, R_i the
rotation of r_i = q_i q'_i^-1, j over the k nearest neighbours of i at the first time, and lengths in `unit`:

    rigidity = mean_ij sqrt(w_ij) |R_i^T (x_j - x_i) - (x'_j - x'_i)|
    rotation = mean_ij sqrt(w_ij) |r_j - r_i|
    isometry = mean_ij sqrt(w_ij) | |x_j - x_i| - d_ij |,   d_ij the distance at the first time,
    w_ij     = exp(-2000 d_ij^2)

The publication's lengths are metres on people-sized subjects, and 2000 = 1 / (22 mm)^2 is as far as neighbours are
apart there. Scenes of another size, or with Gaussians of another density, would have no neighbours or too many. So the
unit of length here is the one in which the median distance of neighbours is 1 / sqrt(2000): the median pair has the
weight 1/e in every scene, and the terms keep their proportions to each other and to the image loss.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.gaussians.parameters import nearest
from spike4dgs.method.splat.kernels.jit import kernel
from spike4dgs.method.splat.reference import rotation_matrices

SHARPNESS = 2000.0  # of w, in 1 / unit^2


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The k nearest neighbours of N points at the first time, and how much each pair counts."""

    index: Tensor  # [N, k]
    root: Tensor  # [N, k] sqrt(w)
    rest: Tensor  # [N, k] distance in `unit`
    unit: float  # m


def find_neighbours(points: Tensor, k: int) -> Neighbours:
    """Return the graph of points [N, 3] m with `k` neighbours each, or all others where there are fewer.

    Raises UserError for fewer than two points, and where most neighbours coincide.
    """
    if len(points) < 2:
        raise problem("tracking", "at least 2 moving Gaussians", str(len(points)), "use a recipe for static scenes")
    order, lengths = nearest(points, min(k, len(points) - 1))
    unit = float(lengths.median()) * math.sqrt(SHARPNESS)
    if unit == 0:
        raise problem("tracking", "Gaussians at different positions", "coincident ones", "correct the initialization")
    rest = (lengths / unit).to(points)
    return Neighbours(order, torch.exp(-0.5 * SHARPNESS * rest**2), rest, unit)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Return the quaternion product a b, wxyz, [..., 4]."""
    w, x, y, z = a.unbind(-1)
    s, t, u, v = b.unbind(-1)
    return torch.stack(
        [
            w * s - x * t - y * u - z * v,
            w * t + x * s + y * v - z * u,
            w * u - x * v + y * s + z * t,
            w * v + x * u - y * t + z * s,
        ],
        dim=-1,
    )


def conjugate(q: Tensor) -> Tensor:
    """Return the inverse of unit quaternions [..., 4]."""
    return q * q.new_tensor([1.0, -1.0, -1.0, -1.0])


def unit_quaternions(q: Tensor) -> Tensor:
    """Return quaternions [..., 4] of length 1."""
    return torch.nn.functional.normalize(q, dim=-1)


@dataclass(frozen=True, eq=False)
class Before:
    """The state of the time before, as the terms need it, computed once for all steps of a time."""

    offsets: Tensor  # [N, k, 3] x'_j - x'_i in units
    inverse: Tensor  # [N, 4] conjugate of q'


def remember(graph: Neighbours, means: Tensor, quats: Tensor) -> Before:
    """Return the state of the time before from means [N, 3] m and quats [N, 4], detached."""
    means, quats = means.detach(), quats.detach()
    return Before(_offsets(graph, means), conjugate(unit_quaternions(quats)))


def physical_terms(graph: Neighbours, before: Before, means: Tensor, quats: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return (rigidity, rotation, isometry) of means [N, 3] m and quats [N, 4] of any length; see the module."""
    offsets = _offsets(graph, means)  # [N, k, 3]
    turn = multiply(unit_quaternions(quats), before.inverse)  # [N, 4] r
    back = offsets @ rotation_matrices(turn)  # rows o^T R = (R^T o)^T
    rigidity = (graph.root * (back - before.offsets).norm(dim=-1)).mean()
    rotation = (graph.root * (turn[graph.index] - turn[:, None]).norm(dim=-1)).mean()
    isometry = (graph.root * (offsets.norm(dim=-1) - graph.rest).abs()).mean()
    return rigidity, rotation, isometry


def physical_loss(
    graph: Neighbours, before: Before, means: Tensor, quats: Tensor, weights: tuple[float, float, float]
) -> Tensor:
    """Return weights . `physical_terms`; float32 on the CPU goes through kernels, all else through plain torch."""
    if means.device.type != "cpu" or means.dtype != torch.float32:
        terms = physical_terms(graph, before, means, quats)
        return torch.stack([w * term for w, term in zip(weights, terms, strict=True)]).sum()
    turn = multiply(unit_quaternions(quats), before.inverse)
    value: Tensor = _Terms.apply(means, turn, rotation_matrices(turn), graph, before.offsets, weights)
    return value


def _offsets(graph: Neighbours, means: Tensor) -> Tensor:
    return (means[graph.index] - means[:, None]) / graph.unit


def background_term(means: Tensor, quats: Tensor, means_0: Tensor, quats_0: Tensor, unit: float) -> Tensor:
    """Return mean_i |x_i - x_i(0)|_1 / unit + mean_i |q_i - q_i(0)|_1 of the background; 0 for nothing [0, 3]."""
    if not len(means):
        return means.sum()
    moved = (means - means_0).abs().sum(-1).mean() / unit
    return moved + (unit_quaternions(quats) - unit_quaternions(quats_0)).abs().sum(-1).mean()


def color_term(colors: Tensor, before: Tensor) -> Tensor:
    """Return mean_i |c_i - c'_i|_1: colours [N, F] change slowly."""
    return (colors - before).abs().sum(-1).mean()


class _Terms(torch.autograd.Function):
    """weights . (rigidity, rotation, isometry), differentiable in means [N, 3], turns [N, 4], rotations [N, 3, 3].

    `offsets` [N, k, 3] are those of the time before. float32 on the CPU. The gradient is made together with the value,
    while the pairs are at hand.
    """

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        turns: Tensor,
        rotations: Tensor,
        graph: Neighbours,
        offsets: Tensor,
        weights: tuple[float, float, float],
    ) -> Tensor:
        moved = [t.detach().contiguous().numpy() for t in (means, turns, rotations)]
        gradients = [np.zeros_like(a) for a in moved]
        fixed = [t.contiguous().numpy() for t in (graph.index, graph.root, graph.rest, offsets)]
        parts = tuple(np.float32(w / graph.root.numel()) for w in weights)
        total = _pairs(*fixed, *moved, *parts, np.float32(1 / graph.unit), *gradients)
        ctx.save_for_backward(*map(torch.from_numpy, gradients))
        return torch.tensor(total, dtype=means.dtype)

    @staticmethod
    def backward(ctx: Any, *outer: Tensor) -> tuple[Tensor | None, ...]:
        return (*(g * outer[0] for g in ctx.saved_tensors), None, None, None)


@kernel
def _pairs(  # type: ignore[no-untyped-def]
    index, root, rest, before, means, turns, rotations, rigid, turn, stretch, per_unit, to_means, to_turns, to_rotations
):
    """Weighted sum over all pairs; adds its gradients to the last three arrays. Weights are per pair."""
    total = 0.0
    o, e, p = np.empty(3, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    d = np.empty(4, np.float32)
    for i in range(len(index)):
        R, to_R = rotations[i], to_rotations[i]
        for k in range(index.shape[1]):
            j, w = index[i, k], root[i, k]
            for c in range(3):
                o[c] = (means[j, c] - means[i, c]) * per_unit
                p[c] = 0
            for c in range(3):  # e = R^T o - o'
                e[c] = R[0, c] * o[0] + R[1, c] * o[1] + R[2, c] * o[2] - before[i, k, c]
            miss = np.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
            total += np.float64(rigid * w * miss)
            if miss > 0:
                share = rigid * w / miss
                for a in range(3):
                    for c in range(3):
                        to_R[a, c] += share * o[a] * e[c]
                        p[a] += share * R[a, c] * e[c]
            for c in range(4):
                d[c] = turns[j, c] - turns[i, c]
            apart = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2] + d[3] * d[3])
            total += np.float64(turn * w * apart)
            if apart > 0:
                share = turn * w / apart
                for c in range(4):
                    to_turns[j, c] += share * d[c]
                    to_turns[i, c] -= share * d[c]
            length = np.sqrt(o[0] * o[0] + o[1] * o[1] + o[2] * o[2])
            longer = length - rest[i, k]
            total += np.float64(stretch * w * abs(longer))
            if length > 0:
                share = stretch * w * np.sign(longer) / length
                for c in range(3):
                    p[c] += share * o[c]
            for c in range(3):
                to_means[j, c] += p[c] * per_unit
                to_means[i, c] -= p[c] * per_unit
    return total
