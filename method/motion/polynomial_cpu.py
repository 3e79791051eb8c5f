"""Gaussians on polynomial paths at one time, on the CPU: numba kernels for the values and their gradients.

The twin in plain torch, which says what is computed, is `polynomial.at_time_reference`. A step of training asks for
two times, and torch's fifteen small operations and their gradients cost more there than a render of a view.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spike4dgs.method.splat.kernels import threads
from spike4dgs.method.splat.kernels.jit import kernel
from spike4dgs.method.splat.kernels.vector_ir import fetch_add

ITEM = 1024  # Gaussians per work item

Four = tuple[Tensor, Tensor, Tensor, Tensor]


def at_time_cpu(tensors: tuple[Tensor, ...], t: float) -> Four:
    """Return means, quaternions, scales and opacities at t, differentiable.

    tensors, float32: means [N, 3], log_scales [N, 3], quats [N, 4], logits [N], times [N], log_temporal_scales [N],
    coefficients [N, 9], angular_velocities [N, 4].
    """
    out: Four = _AtTime.apply(t, *tensors)  # type: ignore[no-untyped-call]
    return out


def _scratch(n: int) -> list[tuple[()]]:
    return [()] * threads.useful_threads(n, 4 * ITEM)


class _AtTime(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, t: float, *tensors: Tensor) -> Four:
        ctx.t, ctx.arrays = np.float32(t), tuple(x.detach().contiguous().numpy() for x in tensors)
        means, log_scales, quats, logits = ctx.arrays[:4]
        out = np.empty_like(means), np.empty_like(quats), np.empty_like(log_scales), np.empty_like(logits)
        threads.run(_forward, (ctx.t, *ctx.arrays, *out), _scratch(len(means)))
        ctx.scales = out[2]
        at_t = tuple(torch.from_numpy(x) for x in out)
        return at_t[0], at_t[1], at_t[2], at_t[3]

    @staticmethod
    def backward(ctx: Any, *outer: Tensor) -> tuple[Any, ...]:
        d_means, d_quats, d_scales, d_opacities = (x.contiguous() for x in outer)
        _, log_scales, _, logits, times, durations, coefficients, turning = ctx.arrays
        own = tuple(np.empty_like(x) for x in (log_scales, logits, times, durations, coefficients, turning))
        given = (x.numpy() for x in (d_means, d_quats, d_scales, d_opacities))
        arguments = (ctx.t, logits, times, durations, ctx.scales, *given, *own)
        threads.run(_backward, arguments, _scratch(len(times)))
        d_log_scales, *rest = (torch.from_numpy(x) for x in own)
        return None, d_means, d_log_scales, d_quats, *rest


@kernel
def _forward(
    t: Any, means: Any, log_scales: Any, quats: Any, logits: Any, times: Any, durations: Any, coefficients: Any,
    turning: Any, out_means: Any, out_quats: Any, scales: Any, opacities: Any, counter: Any,
) -> None:  # fmt: skip
    """Fill the last four arrays before `counter`."""
    one = np.float32(1)
    while True:
        first = fetch_add(counter, 0, 1) * ITEM  # type: ignore[call-arg]
        if first >= len(times):
            break
        for i in range(first, min(first + ITEM, len(times))):
            d = t - times[i]
            u = d * math.exp(-durations[i])
            opacities[i] = math.exp(-u * u) / (one + math.exp(-logits[i]))
            for k in range(3):
                m1, m2, m3 = coefficients[i, k], coefficients[i, 3 + k], coefficients[i, 6 + k]
                out_means[i, k] = means[i, k] + d * (m1 + d * (m2 + d * m3))
                scales[i, k] = math.exp(log_scales[i, k])
            for k in range(4):
                out_quats[i, k] = quats[i, k] + d * turning[i, k]


@kernel
def _backward(
    t: Any, logits: Any, times: Any, durations: Any, scales: Any, d_means: Any, d_quats: Any, d_scales: Any,
    d_opacities: Any, d_log_scales: Any, d_logits: Any, d_times: Any, d_durations: Any, d_coefficients: Any,
    d_turning: Any, counter: Any,
) -> None:  # fmt: skip
    """Fill the last six arrays before `counter`. No gradient goes through d = t - times in paths and rotations."""
    one, two = np.float32(1), np.float32(2)
    while True:
        first = fetch_add(counter, 0, 1) * ITEM  # type: ignore[call-arg]
        if first >= len(times):
            break
        for i in range(first, min(first + ITEM, len(times))):
            d = t - times[i]
            shrink = math.exp(-durations[i])
            u = d * shrink
            opacity = one / (one + math.exp(-logits[i]))
            d_opacity = d_opacities[i] * math.exp(-u * u)
            d_logits[i] = d_opacity * opacity * (one - opacity)
            d_u = -two * u * d_opacity * opacity
            d_times[i], d_durations[i] = -d_u * shrink, -d_u * u
            for k in range(3):
                d_log_scales[i, k] = d_scales[i, k] * scales[i, k]
                d_coefficients[i, k] = d_means[i, k] * d
                d_coefficients[i, 3 + k] = d_means[i, k] * d * d
                d_coefficients[i, 6 + k] = d_means[i, k] * d * d * d
            for k in range(4):
                d_turning[i, k] = d_quats[i, k] * d
