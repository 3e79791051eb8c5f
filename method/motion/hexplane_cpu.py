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

from spike4dgs.benchmark.compilation import cached_njit
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


@cached_njit(nogil=True, fastmath=True, error_model="numpy")
def _forward(unit, space, lines, out):  # [N, 3], [3, R, R, F], [3, R, F], [N, F]
    size, features = lines.shape[1], lines.shape[2]
    for n in range(len(unit)):
        i, wi, _ = _cell(unit[n, 0], size)
        j, wj, _ = _cell(unit[n, 1], size)
        k, wk, _ = _cell(unit[n, 2], size)
        vi, vj, vk = np.float32(1) - wi, np.float32(1) - wj, np.float32(1) - wk
        p, q = space[0, i, j : j + 2], space[0, i + 1, j : j + 2]
        r, s = space[1, i, k : k + 2], space[1, i + 1, k : k + 2]
        t, u = space[2, j, k : k + 2], space[2, j + 1, k : k + 2]
        x, y, z = lines[0, i : i + 2], lines[1, j : j + 2], lines[2, k : k + 2]
        for f in range(features):
            xy = vi * (vj * p[0, f] + wj * p[1, f]) + wi * (vj * q[0, f] + wj * q[1, f])
            xz = vi * (vk * r[0, f] + wk * r[1, f]) + wi * (vk * s[0, f] + wk * s[1, f])
            yz = vj * (vk * t[0, f] + wk * t[1, f]) + wj * (vk * u[0, f] + wk * u[1, f])
            line = (vi * x[0, f] + wi * x[1, f]) * (vj * y[0, f] + wj * y[1, f]) * (vk * z[0, f] + wk * z[1, f])
            out[n, f] = xy * xz * yz * line


@cached_njit(nogil=True, fastmath=True, error_model="numpy")
def _backward(unit, space, lines, grad, grad_unit, grad_space, grad_lines):
    size, features = lines.shape[1], lines.shape[2]
    one = np.float32(1)
    for n in range(len(unit)):
        i, wi, si = _cell(unit[n, 0], size)
        j, wj, sj = _cell(unit[n, 1], size)
        k, wk, sk = _cell(unit[n, 2], size)
        vi, vj, vk = one - wi, one - wj, one - wk
        p, q = space[0, i, j : j + 2], space[0, i + 1, j : j + 2]
        r, s = space[1, i, k : k + 2], space[1, i + 1, k : k + 2]
        t, u = space[2, j, k : k + 2], space[2, j + 1, k : k + 2]
        x, y, z = lines[0, i : i + 2], lines[1, j : j + 2], lines[2, k : k + 2]
        dp, dq = grad_space[0, i, j : j + 2], grad_space[0, i + 1, j : j + 2]
        dr, ds = grad_space[1, i, k : k + 2], grad_space[1, i + 1, k : k + 2]
        dt, du = grad_space[2, j, k : k + 2], grad_space[2, j + 1, k : k + 2]
        dx, dy, dz = grad_lines[0, i : i + 2], grad_lines[1, j : j + 2], grad_lines[2, k : k + 2]
        gi = gj = gk = np.float32(0)
        for f in range(features):
            p0, p1 = vj * p[0, f] + wj * p[1, f], vj * q[0, f] + wj * q[1, f]
            r0, r1 = vk * r[0, f] + wk * r[1, f], vk * s[0, f] + wk * s[1, f]
            t0, t1 = vk * t[0, f] + wk * t[1, f], vk * u[0, f] + wk * u[1, f]
            xy, xz, yz = vi * p0 + wi * p1, vi * r0 + wi * r1, vj * t0 + wj * t1
            lx, ly, lz = vi * x[0, f] + wi * x[1, f], vj * y[0, f] + wj * y[1, f], vk * z[0, f] + wk * z[1, f]
            g = grad[n, f]
            planes, line = xy * xz * yz, lx * ly * lz
            gxy, gxz, gyz = g * line * xz * yz, g * line * xy * yz, g * line * xy * xz
            gx, gy, gz = g * planes * ly * lz, g * planes * lx * lz, g * planes * lx * ly
            dp[0, f] += gxy * vi * vj
            dp[1, f] += gxy * vi * wj
            dq[0, f] += gxy * wi * vj
            dq[1, f] += gxy * wi * wj
            dr[0, f] += gxz * vi * vk
            dr[1, f] += gxz * vi * wk
            ds[0, f] += gxz * wi * vk
            ds[1, f] += gxz * wi * wk
            dt[0, f] += gyz * vj * vk
            dt[1, f] += gyz * vj * wk
            du[0, f] += gyz * wj * vk
            du[1, f] += gyz * wj * wk
            dx[0, f] += gx * vi
            dx[1, f] += gx * wi
            dy[0, f] += gy * vj
            dy[1, f] += gy * wj
            dz[0, f] += gz * vk
            dz[1, f] += gz * wk
            gi += gxy * (p1 - p0) + gxz * (r1 - r0) + gx * (x[1, f] - x[0, f])
            gj += gyz * (t1 - t0) + gy * (y[1, f] - y[0, f])
            gj += gxy * (vi * (p[1, f] - p[0, f]) + wi * (q[1, f] - q[0, f]))
            gk += gxz * (vi * (r[1, f] - r[0, f]) + wi * (s[1, f] - s[0, f])) + gz * (z[1, f] - z[0, f])
            gk += gyz * (vj * (t[1, f] - t[0, f]) + wj * (u[1, f] - u[0, f]))
        grad_unit[n, 0], grad_unit[n, 1], grad_unit[n, 2] = gi * si, gj * sj, gk * sk


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
