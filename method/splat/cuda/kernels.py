"""The hand-written kernels: composite the tiles' lists, the reverse, and the sum of each Gaussian's gradient records.

One block of 256 threads renders one tile of 16 x 16 pixels, one thread a pixel. A Gaussian's row in `records` [., 6]
float64 is: centre x, y; slope of its ridge line; xi and eta scales; opacity. In the whitened coordinates
xi = xi_scale dx and eta = eta_scale (dy - slope dx), alpha = opacity exp(-xi^2 - eta^2). The offsets of a tile's first
pixel are computed in float64 and the rest in float32, so a thin Gaussian far from the image's corner stays sharp.

The backward kernel replays a tile front to back. Per eight Gaussians it runs in two passes over shared memory: first
each thread computes its pixel's s = dL/d ln(alpha) and weight for all eight; then each 32 threads sum over the pixels
of one of them. That takes fewer operations than a shuffle per value, adds in a fixed order, and runs in the simulator,
which has no shuffles. Each Gaussian-tile pair owns one row of `sums`, so nothing is added atomically: equal inputs give
equal bits.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numba import cuda, float32, int64

from spike4dgs.benchmark.compilation import cached_jit
from spike4dgs.method.splat.cuda.prepare import TILE
from spike4dgs.method.splat.types import ALPHA_MAX, ALPHA_MIN, T_MIN

THREADS = TILE * TILE
BATCH = 128  # Gaussians in shared memory at a time
GROUP = 8  # Gaussians of one backward pass
SHARE = THREADS // GROUP  # threads that sum one Gaussian
MOMENTS = 6  # sums of s, s xi, s eta, s xi^2, s xi eta, s eta^2


def _jit(function: Any) -> Any:
    return cached_jit(cuda.jit, fastmath=True)(function)


def _helper(function: Any) -> Any:
    return cuda.jit(device=True, fastmath=True)(function)


@cache
def blend_kernels(channels: int) -> tuple[Any, Any]:
    """Return the (forward, backward) kernels for this number of layers.

    What comes from other modules is in their closures, which numba's cache key covers.
    """
    tile, threads, share = TILE, THREADS, SHARE
    fields, values, lanes = 6 + channels, MOMENTS + channels, SHARE + 1  # one more: no two values in one bank
    alpha_min, alpha_max, t_min = np.float32(ALPHA_MIN), np.float32(ALPHA_MAX), np.float32(T_MIN)
    zero, one = np.float32(0), np.float32(1)

    @_helper
    def load(records: Any, layers: Any, row: int, x0: int, y0: int, out: Any) -> None:
        """Prepare a Gaussian for the tile whose first pixel is (x0, y0)."""
        dx, dy = x0 + 0.5 - records[row, 0], y0 + 0.5 - records[row, 1]
        slope, xi_scale, eta_scale = records[row, 2], records[row, 3], records[row, 4]
        out[0] = xi_scale * dx  # xi and eta there
        out[1] = eta_scale * (dy - slope * dx)
        out[2] = xi_scale  # xi from column to column
        out[3] = eta_scale * slope  # eta back from column to column
        out[4] = eta_scale  # eta from row to row
        out[5] = records[row, 5]
        for c in range(channels):
            out[6 + c] = layers[row, c]

    @_jit
    def forward(
        records: Any, layers: Any, rows: Any, offsets: Any, blocks: Any, across: int, down: int, image: Any, alpha: Any
    ) -> None:
        """Composite the tiles `blocks` [K] = view * tiles + tile into image [C, channels, H, W] and alpha [C, H, W]."""
        batch = cuda.shared.array((BATCH, fields), float32)
        color = cuda.local.array(channels, float32)
        thread, block = cuda.threadIdx.x, blocks[cuda.blockIdx.x]
        view, at = block // (across * down), block % (across * down)
        x0, y0 = at % across * tile, at // across * tile
        ix, iy = thread % tile, thread // tile
        inside = x0 + ix < image.shape[3] and y0 + iy < image.shape[2]
        fx, fy = np.float32(ix), np.float32(iy)
        T, done = one, not inside
        for c in range(channels):
            color[c] = zero
        begin, end = offsets[block], offsets[block + 1]
        while begin < end:
            if cuda.syncthreads_count(1 if done else 0) == threads:
                break
            count = min(BATCH, end - begin)
            if thread < count:
                load(records, layers, rows[begin + thread], x0, y0, batch[thread])
            cuda.syncthreads()
            k = int64(0)
            while k < count and not done:
                xi = batch[k, 0] + batch[k, 2] * fx
                eta = batch[k, 1] - batch[k, 3] * fx + batch[k, 4] * fy
                raw = batch[k, 5] * float32(math.exp(-(xi * xi + eta * eta)))
                if raw >= alpha_min:
                    weight = T * min(raw, alpha_max)
                    if T - weight > t_min:
                        T = T - weight
                        for c in range(channels):
                            color[c] += weight * batch[k, 6 + c]
                    else:
                        done = True
                k += 1
            begin += count
        if inside:
            alpha[view, y0 + iy, x0 + ix] = one - T
            for c in range(channels):
                image[view, c, y0 + iy, x0 + ix] = color[c]

    @_jit
    def backward(
        records: Any, layers: Any, rows: Any, slots: Any, offsets: Any, blocks: Any, across: int, down: int,
        image: Any, alpha: Any, d_image: Any, d_alpha: Any, sums: Any,
    ) -> None:  # fmt: skip
        """Write the moments and the layers' gradients of each Gaussian-tile pair with a slot to sums [P, values].

        With cg = sum_f dL/dC_f c_f + dL/dA, a Gaussian's own share of the loss is w cg, and everything behind it
        scales with 1 - alpha: dL/dalpha = T cg - R_behind / (1 - alpha). T and R are replayed, never divided back.
        """
        batch = cuda.shared.array((BATCH, fields), float32)
        pair = cuda.shared.array(BATCH, int64)
        shared_s = cuda.shared.array((GROUP, THREADS), float32)
        shared_weight = cuda.shared.array((GROUP, THREADS), float32)
        gradient = cuda.shared.array((channels, THREADS), float32)
        partial = cuda.shared.array((GROUP, values, lanes), float32)
        own = cuda.local.array(values, float32)
        thread, block = cuda.threadIdx.x, blocks[cuda.blockIdx.x]
        view, at = block // (across * down), block % (across * down)
        x0, y0 = at % across * tile, at // across * tile
        ix, iy = thread % tile, thread // tile
        inside = x0 + ix < image.shape[3] and y0 + iy < image.shape[2]
        fx, fy = np.float32(ix), np.float32(iy)
        T, done = one, not inside
        d_opaque, rest = zero, zero
        for c in range(channels):
            gradient[c, thread] = zero
        if inside:
            d_opaque = d_alpha[view, y0 + iy, x0 + ix]
            rest = d_opaque * alpha[view, y0 + iy, x0 + ix]
            for c in range(channels):
                gradient[c, thread] = d_image[view, c, y0 + iy, x0 + ix]
                rest += gradient[c, thread] * image[view, c, y0 + iy, x0 + ix]
        # In the second pass the thread sums the pixels `lane`, `lane + 32`, ... of Gaussian `mine` of the group.
        mine, lane = thread // share, thread % share
        lx = np.float32(lane % tile)
        begin, end = offsets[block], offsets[block + 1]
        while begin < end:
            if cuda.syncthreads_count(1 if done else 0) == threads:
                break
            count = min(BATCH, end - begin)
            if thread < count:
                pair[thread] = slots[begin + thread]
                load(records, layers, rows[begin + thread], x0, y0, batch[thread])
            cuda.syncthreads()
            for first in range(0, count, GROUP):
                for g in range(GROUP):
                    k = first + g
                    s, weight = zero, zero
                    if k < count and not done:
                        xi = batch[k, 0] + batch[k, 2] * fx
                        eta = batch[k, 1] - batch[k, 3] * fx + batch[k, 4] * fy
                        raw = batch[k, 5] * float32(math.exp(-(xi * xi + eta * eta)))
                        if raw >= alpha_min:
                            opacity = min(raw, alpha_max)
                            weight = T * opacity
                            if T - weight > t_min:
                                share_of_loss = d_opaque
                                for c in range(channels):
                                    share_of_loss += gradient[c, thread] * batch[k, 6 + c]
                                rest -= weight * share_of_loss
                                if raw <= alpha_max:  # a clamped alpha does not move
                                    s = (T * share_of_loss - rest / (one - opacity)) * raw
                                T = T - weight
                            else:
                                done, weight = True, zero
                    shared_s[g, thread] = s
                    shared_weight[g, thread] = weight
                cuda.syncthreads()
                k = first + mine
                wanted = k < count and pair[k] >= 0  # the background wants no gradient
                if wanted:
                    for j in range(values):
                        own[j] = zero
                    xi = batch[k, 0] + batch[k, 2] * lx
                    eta_left = batch[k, 1] - batch[k, 3] * lx
                    for p in range(lane, threads, share):
                        s, weight = shared_s[mine, p], shared_weight[mine, p]
                        eta = eta_left + batch[k, 4] * np.float32(p // tile)
                        own[0] += s
                        own[1] += s * xi
                        own[2] += s * eta
                        own[3] += s * xi * xi
                        own[4] += s * xi * eta
                        own[5] += s * eta * eta
                        for c in range(channels):
                            own[MOMENTS + c] += weight * gradient[c, p]
                    for j in range(values):
                        partial[mine, j, lane] = own[j]
                cuda.syncthreads()
                if wanted:
                    for j in range(lane, values, share):
                        total = zero
                        for other in range(share):
                            total += partial[mine, j, other]
                        sums[pair[k], j] = total
            begin += count

    return forward, backward


@_jit
def sum_pairs(sums: Any, starts: Any, totals: Any) -> None:
    """Sum the records [P, values] of each Gaussian's pairs starts[m]:starts[m + 1] into totals [M, values] float64."""
    at = cuda.grid(1)
    if at < totals.size:
        m, j = at // totals.shape[1], at % totals.shape[1]
        total = 0.0
        for p in range(starts[m], starts[m + 1]):
            total += sums[p, j]
        totals[m, j] = total
