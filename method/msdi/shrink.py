"""Streams of larger pixels, for a network that was trained at low resolution.

Attention costs the square of the number of patches, and a network works best at the size of its training. A stream
cannot be resized like an image, but the spikes of several pixels can charge one larger pixel, which fires whenever the
sum makes a whole spike for each of them. This is again a stream of 0 and 1, of the mean rate to within one spike.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from spike4dgs.benchmark.errors import problem


def shrink(spikes: Tensor, factor: int) -> Tensor:
    """Return a stream [..., T, H, W] of 0 and 1 in blocks of `factor` x `factor` pixels, sides rounded up, float32.

    A block at the border has only the pixels inside. All blocks begin half charged. Raises UserError for a factor below
    1.
    """
    if factor < 1:
        raise problem("spikes", "a factor of 1 or more", str(factor), "give 1 to keep the size")
    if factor == 1:
        return spikes.float()
    ticks, height, width = spikes.shape[-3:]
    margin = (0, -width % factor, 0, -height % factor)
    inside = functional.pad(torch.ones(1, 1, height, width, device=spikes.device), margin)
    pixels = _block_sums(inside, factor).double()
    counts = _block_sums(functional.pad(spikes.float().reshape(-1, ticks, height, width), margin), factor)
    # Double: sums of 10^5 ticks are exact, and half a block is representable.
    whole = torch.floor((counts.double().cumsum(dim=1) + pixels / 2) / pixels)
    fired = torch.diff(whole, dim=1, prepend=torch.zeros_like(whole[:, :1])).float()
    return fired.reshape(*spikes.shape[:-2], *fired.shape[-2:])


def shrink_intrinsics(intrinsics: Tensor, factor: int) -> Tensor:
    """Return intrinsics [..., 3, 3] in blocks, which start at the corner of the first pixel, from those in pixels."""
    scale = torch.tensor([1 / factor, 1 / factor, 1.0], dtype=intrinsics.dtype, device=intrinsics.device)
    return intrinsics * scale[:, None]


def _block_sums(x: Tensor, factor: int) -> Tensor:
    """Return the sums over blocks of [N, C, H, W], exact for whole numbers."""
    return functional.avg_pool2d(x, factor, divisor_override=1)
