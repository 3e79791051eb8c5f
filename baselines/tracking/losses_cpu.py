"""The terms of `tracking_losses` on the CPU: value and gradient of their weighted sum in one pass over the pairs.

The twin in plain torch is `tracking_losses.physical_terms`, which takes three times as long: it writes every
intermediate of every pair to memory.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from spike4dgs.method.splat.kernels.jit import kernel


def weighted_terms(
    graph: tuple[Tensor, Tensor, Tensor, float],
    offsets: Tensor,
    means: Tensor,
    turns: Tensor,
    rotations: Tensor,
    weights: tuple[float, float, float],
) -> Tensor:
    """weights . (rigidity, rotation, isometry), differentiable in means [N, 3], turns [N, 4], rotations [N, 3, 3].

    graph: (index [N, k], root [N, k], rest [N, k], unit); offsets [N, k, 3] of the time before. float32 on the CPU.
    """
    value: Tensor = _Terms.apply(means, turns, rotations, graph, offsets, weights)  # type: ignore[no-untyped-call]
    return value


class _Terms(torch.autograd.Function):
    """The gradient is made together with the value, while the pairs are at hand."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        turns: Tensor,
        rotations: Tensor,
        graph: tuple[Tensor, Tensor, Tensor, float],
        offsets: Tensor,
        weights: tuple[float, float, float],
    ) -> Tensor:
        index, root, rest, unit = graph
        moved = [t.detach().contiguous().numpy() for t in (means, turns, rotations)]
        gradients = [np.zeros_like(a) for a in moved]
        fixed = [t.contiguous().numpy() for t in (index, root, rest, offsets)]
        parts = tuple(np.float32(w / root.numel()) for w in weights)
        total = _pairs(*fixed, *moved, *parts, np.float32(1 / unit), *gradients)
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
