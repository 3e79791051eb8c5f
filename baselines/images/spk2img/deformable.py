"""Modulated deformable convolution (DCNv2), 3x3: an offset moves every tap of every group.

y(p) = bias + sum over taps k of weight_k * mask_k(p) * x(p + k + offset_k(p)), x read bilinearly and 0 outside the
image (Zhu, Hu, Lin, Dai: Deformable ConvNets v2, CVPR 2019). The samples of all taps and groups are one call of
`grid_sample`, the sum over taps and channels is one matrix product. Without gradients,
`deformable_cpu` does the same on the CPU in a quarter of the time.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from spike4dgs.baselines.images.spk2img import deformable_cpu
from spike4dgs.baselines.images.spk2img.deformable_cpu import TAPS


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
        suits = x.device.type == "cpu" and x.dtype == torch.float32 and channels == deformable_cpu.GROUP * self.groups
        if suits and not torch.is_grad_enabled():
            return deformable_cpu.convolve(x, found, self.weight, self.bias)
        found = found.contiguous()  # channels last would make every step below slow
        split = self.groups * TAPS * 2
        offsets = found[:, :split].reshape(batch, self.groups, TAPS, 2, height, width)
        masks = torch.sigmoid(found[:, split:]).view(batch, self.groups, TAPS, height, width)
        return deformable_conv(x, offsets, masks, self.weight, self.bias)
