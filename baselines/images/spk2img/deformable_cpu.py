"""The samples of a deformable convolution on the CPU, for inference: a numba kernel beside `grid_sample`'s way.

All groups, taps and channels of a pixel are read and written where they lie beside one another (channels last), the
mask goes into the four bilinear weights, and no grid is written down. The twin is `deformable.deformable_conv`.
"""

from __future__ import annotations

import functools
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numba import njit, types
from numba.extending import intrinsic
from torch import Tensor

from spike4dgs.benchmark.compilation import cached_njit
from spike4dgs.method.splat.kernels.vector_ir import Lanes, array_data, offset

TAPS = 9
GROUP = 8  # channels of a group, which the kernel knows when it is compiled: one vector


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, "deformable")


@intrinsic  # type: ignore[untyped-decorator]
def _blend(typing_context: Any, x: Any, corners: Any, weights: Any, columns: Any, at: Any) -> Any:
    """Set columns[at : at + 8] to the sum of four weights[j] * x[corners[j] : corners[j] + 8]; both arrays are flat."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes = Lanes(builder, GROUP)
        source, target = (array_data(context, builder, sig.args[i], args[i]) for i in (0, 3))
        total = lanes.const(0)
        for j in range(4):
            corner = lanes.load(offset(builder, source, builder.extract_value(args[1], j)))
            total = lanes.fma(lanes.splat(builder.extract_value(args[2], j)), corner, total)
        lanes.store(total, offset(builder, target, args[4]))
        return context.get_dummy_value()

    return types.void(x, corners, weights, columns, at), generate


@njit(inline="always")
def _side(position: np.float32, size: int) -> tuple[int, int, np.float32, np.float32]:
    """Return the two neighbours of a position within the image, and their weights: 0 for a neighbour outside."""
    position = min(max(position, np.float32(-2)), np.float32(size + 1))  # no offset is too large for an integer
    low = np.floor(position)
    i, upper = int(low), position - low
    lower = np.float32(1) - upper if 0 <= i < size else np.float32(0)
    upper = upper if -1 <= i < size - 1 else np.float32(0)
    return min(max(i, 0), size - 1), min(max(i + 1, 0), size - 1), lower, upper


# flat [B, H, W, C], [B, H, W, G * 9 * 3], flat [B, H, W, 9, C]
@cached_njit(nogil=True, fastmath={"contract", "nsz", "arcp", "afn"}, error_model="numpy")
def _sample(x, found, columns, channels, first, step):
    batch, height, width, _ = found.shape
    groups = channels // GROUP
    one = np.float32(1)
    for item in range(first, batch * height, step):
        b, row = item // height, item % height
        for column in range(width):
            guide = found[b, row, column]
            at = (item * width + column) * TAPS * channels
            for g in range(groups):
                for k in range(TAPS):
                    i = 2 * (g * TAPS + k)
                    mask = one / (one + np.exp(-guide[2 * groups * TAPS + g * TAPS + k]))
                    left, right, w0, w1 = _side(np.float32(column + k % 3 - 1) + guide[i], width)
                    top, bottom, h0, h1 = _side(np.float32(row + k // 3 - 1) + guide[i + 1], height)
                    h0, h1 = h0 * mask, h1 * mask
                    top, bottom = (b * height + top) * width, (b * height + bottom) * width
                    c0 = g * GROUP
                    corners = (
                        (top + left) * channels + c0,
                        (top + right) * channels + c0,
                        (bottom + left) * channels + c0,
                        (bottom + right) * channels + c0,
                    )
                    weights = h0 * w0, h0 * w1, h1 * w0, h1 * w1
                    _blend(x, corners, weights, columns, at + k * channels + c0)


def convolve(x: Tensor, found: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return the deformable convolution of x [B, C, H, W] float32 with weight [O, C, 3, 3]; no gradients.

    found [B, G * 27, H, W] has the offsets and the masks before their sigmoid, as DeformableConv's guide gives them.
    """
    batch, channels, height, width = x.shape
    pixels, guides = (t.permute(0, 2, 3, 1).contiguous().numpy() for t in (x, found))
    columns = torch.empty(batch, height, width, TAPS * channels)
    sample: Any = functools.partial(_sample, pixels.reshape(-1), guides, columns.view(-1).numpy(), channels)
    helper = _pool().submit(sample, 1, 2)  # every other row of pixels each
    sample(0, 2)
    helper.result()
    matrix = weight.permute(2, 3, 1, 0).reshape(TAPS * channels, -1)
    return (columns.view(-1, TAPS * channels) @ matrix).add_(bias).view(batch, height, width, -1).permute(0, 3, 1, 2)
