"""The HexPlane lookup on the CPU: numba kernels for the product of six interpolated features, and their gradients.

All Gaussians of a step share one time, so that the three time planes become lines and a lookup reads 3 * 4 + 3 * 2
vectors instead of 6 * 4. The twin in plain torch is `hexplane.sample_level`. Gradients go to planes, lines and points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.compilation import cached_njit
from spike4dgs.method.motion.hexplane_ir import add_gradients, look_up
from spike4dgs.method.two_threads import on_two_threads


@njit(inline="always")
def _cell(u: np.float32, size: int) -> tuple[int, np.float32, np.float32]:
    """Return lower cell, weight of the upper one, and cells per unit (0 where the point is clamped to the border)."""
    x = u * np.float32(size - 1)
    slope = np.float32(size - 1)
    if x <= 0:
        x, slope = np.float32(0), np.float32(0)
    elif x >= size - 1:
        x, slope = np.float32(size - 1), np.float32(0)
    i = max(min(int(x), size - 2), 0)  # in this order: NaN must not become an address
    return i, x - np.float32(i), slope


@njit(inline="always")
def _place(unit: Any, n: int, size: int) -> Any:
    """Return ((i, j, k), (wi, wj, wk)) of a point, and its cells per unit along each axis."""
    i, wi, si = _cell(unit[n, 0], size)
    j, wj, sj = _cell(unit[n, 1], size)
    k, wk, sk = _cell(unit[n, 2], size)
    return ((i, j, k), (wi, wj, wk)), (si, sj, sk)


@cached_njit(nogil=True, error_model="numpy")
def _forward(unit: Float32, space: Float32, lines: Float32, out: Float32) -> None:
    """Set features [N, F] of points [N, 3]: planes [3, R, R, F], lines [3, R, F]."""
    size, features = lines.shape[1], lines.shape[2]
    for n in range(len(unit)):
        look_up(space, lines, size, features, _place(unit, n, size)[0], out, n * features)


@cached_njit(nogil=True, error_model="numpy")
def _backward(
    unit: Float32,
    space: Float32,
    lines: Float32,
    grad: Float32,
    grad_unit: Float32,
    grad_space: Float32,
    grad_lines: Float32,
) -> None:
    """Set the gradients of the points, and add those of planes and lines; `grad` may be columns of a wider array."""
    size, features, row = lines.shape[1], lines.shape[2], grad.strides[0] // grad.itemsize
    for n in range(len(unit)):
        at, slopes = _place(unit, n, size)
        own = add_gradients(space, lines, size, features, at, grad, n * row, grad_space, grad_lines)
        for axis in range(3):
            grad_unit[n, axis] = own[axis] * slopes[axis]


def _each_level(jobs: list[tuple[Any, ...]]) -> None:
    """Run one kernel call per level, half of them on a second thread. Every result is written by one thread only."""
    on_two_threads(lambda some: [job[0](*job[1:]) for job in some], jobs[0::2], jobs[1::2])


class _Levels(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, unit: Tensor, levels: int, *planes: Tensor) -> Tensor:
        space, lines = planes[:levels], planes[levels:]
        arrays = [(s.detach().numpy(), a.detach().numpy()) for s, a in zip(space, lines, strict=True)]
        x = unit.detach().contiguous().numpy()
        out = [np.empty((len(x), a.shape[2]), np.float32) for _, a in arrays]
        _each_level([(_forward, x, s, a, o) for (s, a), o in zip(arrays, out, strict=True)])
        ctx.save_for_backward(unit, *planes)
        ctx.levels = levels
        return torch.from_numpy(np.concatenate(out, 1))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        unit, *planes = ctx.saved_tensors
        arrays = [p.detach().numpy() for p in planes]
        x, out = unit.detach().contiguous().numpy(), [np.zeros_like(a) for a in arrays]
        per_level = np.split(grads[0].contiguous().numpy(), ctx.levels, axis=1)
        to_x = [np.empty_like(x) for _ in per_level]
        levels = range(ctx.levels)
        _each_level(
            [
                (_backward, x, arrays[v], arrays[v + ctx.levels], per_level[v], to_x[v], out[v], out[v + ctx.levels])
                for v in levels
            ]
        )
        return torch.from_numpy(sum(to_x)), None, *(torch.from_numpy(g) for g in out)


def sample_levels(unit: Tensor, lines: list[Tensor], space: list[Tensor]) -> Tensor:
    """Return products [N, levels * F] of all levels at unit points [N, 3]: lines [3, R, F], planes [3, R, R, F]."""
    out: Tensor = _Levels.apply(unit, len(space), *space, *(line.contiguous() for line in lines))
    return out
