"""A three-layer perceptron with several heads, of which each reads activations of its own."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def perceptron(x: Tensor, layers: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return V_j relu(W2 relu(W1 x + b1) + b2)_j + c_j, one [N, size] a head j, for rows x [N, D].

    `layers` is [W1, b1, W2, b2, V_0, c_0, V_1, c_1, ...]. The second layer's outputs are cut into as many equal parts
    as there are heads.
    """
    if x.device.type != "cpu" or x.dtype != torch.float32:
        return perceptron_reference(x, layers)
    from spike4dgs.method.motion.mlp_cpu import perceptron_on_cpu

    return perceptron_on_cpu(x, layers)


def perceptron_reference(x: Tensor, layers: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return the same in plain torch, on any device."""
    w1, b1, w2, b2, *heads = layers
    h = ((x @ w1.T + b1).relu() @ w2.T + b2).relu()
    parts = h.chunk(len(heads) // 2, -1)
    return tuple(part @ v.T + c for part, v, c in zip(parts, heads[0::2], heads[1::2], strict=True))
