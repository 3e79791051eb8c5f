"""Modulated deformable convolution (DCNv2), 3x3: an offset moves every tap of every group.

y(p) = bias + sum over taps k of weight_k * mask_k(p) * x(p + k + offset_k(p)), x read bilinearly and 0 outside the
image (Zhu, Hu, Lin, Dai: Deformable ConvNets v2, CVPR 2019). The samples of all taps and groups are one call of
`grid_sample`, the sum over taps and channels is one matrix product. Without gradients, `convolve` does the same on the
CPU in a quarter of the time: channels lie beside one another, the mask goes into the four bilinear weights, and no grid
is written down.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit, types
from numba.extending import intrinsic
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from spike4dgs.benchmark.compilation import cached_njit
from spike4dgs.method.splat.kernels.vector_ir import Lanes, array_data, offset
from spike4dgs.method.two_threads import on_two_threads


def deformable_conv(x: Tensor, offsets: Tensor, masks: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return the convolution of x [B, C, H, W] with weight [O, C, 3, 3] and bias [O]: [B, O, H, W].

    offsets [B, G, 9, 2, H, W] are pixels (right, down), masks [B, G, 9, H, W]; taps run row by row from the top left.
    The C channels are G groups of neighbours; each group has its own offsets and masks.
    """
    batch, channels, height, width = x.shape
    groups = offsets.shape[1]
    u = offsets[:, :, :, 0] + _centers(width, x).view(1, 1, 1, 1, width) + _taps(x).repeat(3).view(TAPS, 1, 1)
    v = offsets[:, :, :, 1] + _centers(height, x).view(1, 1, 1, height, 1)
    v = v + _taps(x).repeat_interleave(3).view(TAPS, 1, 1)
    # grid_sample without aligned corners: the image's outer edges, half a pixel off the outer centres, are -1 and 1.
    grid = torch.stack([u * (2 / width) - 1, v * (2 / height) - 1], dim=-1)  # [B, G, 9, H, W, 2]
    samples = F.grid_sample(
        x.reshape(batch * groups, channels // groups, height, width),
        grid.view(batch * groups, TAPS * height, width, 2),
        mode="bilinear",
        padding_mode="zeros",
        align_corners=False,
    ).view(batch, groups, channels // groups, TAPS, height, width)
    columns = (samples * masks[:, :, None]).view(batch, channels * TAPS, height * width)
    return (weight.flatten(1) @ columns + bias[:, None]).view(batch, -1, height, width)


def _centers(n: int, like: Tensor) -> Tensor:
    """Return coordinates [n] of pixel centres, in the type and on the device of `like`."""
    return torch.arange(n, dtype=like.dtype, device=like.device) + 0.5


def _taps(like: Tensor) -> Tensor:
    return torch.arange(-1, 2, dtype=like.dtype, device=like.device)


class DeformableConv(nn.Module):
    """A deformable convolution whose offsets and masks are a 3x3 convolution of a guide.

    That convolution starts at zero: no offsets, and masks of 1/2.
    """

    def __init__(self, width: int, groups: int) -> None:
        super().__init__()
        self.weight, self.bias = nn.Conv2d(width, width, 3, padding=1).parameters()
        self.guide = nn.Conv2d(width, groups * TAPS * 3, 3, padding=1)
        for parameter in self.guide.parameters():
            nn.init.zeros_(parameter)
        self.groups = groups

    def forward(self, x: Tensor, guide: Tensor) -> Tensor:
        """Return [B, width, H, W] from feature x and guide, both [B, width, H, W]."""
        batch, channels, height, width = x.shape
        found = self.guide(guide)
        suits = x.device.type == "cpu" and x.dtype == torch.float32 and channels == GROUP * self.groups
        if suits and not torch.is_grad_enabled():
            return convolve(x, found, self.weight, self.bias)
        found = found.contiguous()  # channels last would make every step below slow
        split = self.groups * TAPS * 2
        offsets = found[:, :split].reshape(batch, self.groups, TAPS, 2, height, width)
        masks = torch.sigmoid(found[:, split:]).view(batch, self.groups, TAPS, height, width)
        return deformable_conv(x, offsets, masks, self.weight, self.bias)


TAPS = 9
GROUP = 8  # channels of a group, which the kernel knows when it is compiled: one vector


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
    given = pixels.reshape(-1), guides, columns.view(-1).numpy(), channels
    on_two_threads(lambda first: _sample(*given, first, 2), 0, 1)  # every other row of pixels each
    matrix = weight.permute(2, 3, 1, 0).reshape(TAPS * channels, -1)
    return (columns.view(-1, TAPS * channels) @ matrix).add_(bias).view(batch, height, width, -1).permute(0, 3, 1, 2)
