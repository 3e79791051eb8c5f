"""Spk2ImgNet: an image from 41 ticks of spikes (Zhao, Xiong, Liu, Huang: Spk2ImgNet, CVPR 2021).

Five overlapping blocks of 13 ticks each give features, by a shared extractor that fuses four windows of different
length. The features of the outer blocks are aligned to those of the middle one by a pyramid of deformable
convolutions, masked, and fused to one image: the rate of spikes at the middle tick.

All channel counts follow `width`; 64 is the paper's, with 3,904,185 parameters. Deformable groups have 8 channels at
every width (the paper has 8 groups), which keeps the cost proportional to width squared. The published sources leave
open which activation separates a residual block's three convolutions; here it is ReLU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from spike4dgs.baselines.images.spk2img.deformable import DeformableConv
from spike4dgs.method.images.base import mirrored

BLOCK_STARTS = (0, 7, 14, 21, 28)  # of the blocks in the window of 41 ticks
BLOCK = 13  # ticks
BRANCHES = (13, 11, 9, 7)  # ticks in the middle of a block that each branch of the extractor sees
MIDDLE = 2  # the block that the others are aligned to
_RESIDUAL_BLOCKS = 10
_GROUP = 8  # channels of a deformable group
_LEVELS = 3


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The output of the network, in spikes per tick."""

    rate: Tensor  # [B, H, W] at the middle tick
    estimates: Tensor  # [B, 5, 4, H, W] each branch's own estimate at the middle of each block


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1)


def _leaky(x: Tensor) -> Tensor:
    """LeakyReLU in place: only for what was just computed and is not used otherwise."""
    return F.leaky_relu_(x, 0.1)


class _Residual(nn.Module):
    """Three convolutions beside an identity, ReLU after the sum."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            _conv(width, width), nn.ReLU(inplace=True), _conv(width, width), nn.ReLU(inplace=True), _conv(width, width)
        )

    def forward(self, x: Tensor) -> Tensor:
        return F.relu_(x + self.body(x))


class Extractor(nn.Module):
    """The shared extractor: features of a block, and an estimate of the image by each of its four branches."""

    def __init__(self, width: int) -> None:
        super().__init__()
        hidden = max(8, width // 4)  # 16 in the paper
        self.branches = nn.ModuleList(
            nn.Sequential(_conv(n, hidden), nn.ReLU(inplace=True), _conv(hidden, 1)) for n in BRANCHES
        )
        self.weigh = nn.Sequential(_conv(4, 8), nn.ReLU(inplace=True), _conv(8, 4), nn.Sigmoid())
        self.first = nn.Sequential(_conv(4, width), nn.ReLU(inplace=True))
        self.body = nn.Sequential(*(_Residual(width) for _ in range(_RESIDUAL_BLOCKS)))

    def forward(self, block: Tensor) -> tuple[Tensor, Tensor]:
        """Return features [B, width, H, W] and estimates [B, 4, H, W] from spikes [B, 13, H, W]."""
        cuts = [(BLOCK - n) // 2 for n in BRANCHES]
        estimates = torch.cat(
            [branch(block[:, cut : BLOCK - cut]) for cut, branch in zip(cuts, self.branches, strict=True)], dim=1
        )
        x = self.first(self.weigh(estimates) * estimates)
        return x + self.body(x), estimates


class _Level(nn.Module):
    """One level of the alignment: guides from both features, a deformable convolution, and the coarser level's part."""

    def __init__(self, width: int, has_coarser: bool) -> None:
        super().__init__()
        self.compare = _conv(2 * width, width)
        self.merge = _conv(2 * width, width) if has_coarser else None
        self.refine = _conv(width, width)
        self.align = DeformableConv(width, max(1, width // _GROUP))
        self.fuse = _conv(2 * width, width) if has_coarser else None

    def forward(
        self, feature: Tensor, reference: Tensor, coarser: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return guide and aligned feature, before its activation. `coarser` has those of the next coarser level."""
        guide = _leaky(self.compare(torch.cat([feature, reference], dim=1)))
        if coarser is None or self.merge is None or self.fuse is None:
            guide = _leaky(self.refine(guide))
            return guide, self.align(feature, guide)
        # Twice the guide: what is one pixel there is two here.
        guide = _leaky(self.merge(torch.cat([guide, 2 * _double(coarser[0])], dim=1)))
        guide = _leaky(self.refine(guide))
        aligned = self.align(feature, guide)
        return guide, self.fuse(torch.cat([aligned, _double(coarser[1])], dim=1))


def _double(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


class Alignment(nn.Module):
    """Pyramid, cascading, deformable: three levels from coarse to fine, and once more at the finest (after EDVR)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.down = nn.ModuleList(
            nn.Sequential(
                _conv(width, width, stride=2),
                nn.LeakyReLU(0.1, inplace=True),
                _conv(width, width),
                nn.LeakyReLU(0.1, inplace=True),
            )
            for _ in range(_LEVELS - 1)
        )
        self.levels = nn.ModuleList(_Level(width, has_coarser=i < _LEVELS - 1) for i in range(_LEVELS))
        self.cascade = _Level(width, has_coarser=False)

    def pyramid(self, x: Tensor) -> list[Tensor]:
        """Return features at full, half and quarter size."""
        levels = [x]
        for halve in self.down:
            levels.append(halve(levels[-1]))
        return levels

    def forward(self, features: Sequence[Tensor], reference: Sequence[Tensor]) -> Tensor:
        """Return the features [B, width, H, W] aligned to the reference; both are pyramids."""
        guide, aligned = self.levels[-1](features[-1], reference[-1])
        aligned = _leaky(aligned)
        for i in range(_LEVELS - 2, -1, -1):
            guide, aligned = self.levels[i](features[i], reference[i], (guide, aligned))
            aligned = _leaky(aligned) if i else aligned
        return _leaky(self.cascade(aligned, reference[0])[1])


def _mask(width: int) -> nn.Sequential:
    """Return the layers that weight an aligned feature beside the reference: 2 * width channels to width."""
    return nn.Sequential(
        _conv(2 * width, width), nn.PReLU(), _conv(width, width), nn.PReLU(), _conv(width, width), nn.Sigmoid()
    )


class Spk2ImgNet(nn.Module):
    """The network. It takes images of any size: their sides are mirrored up to multiples of four and cut again."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        blocks = len(BLOCK_STARTS)
        self.width = width
        self.extract = Extractor(width)
        self.align = Alignment(width)
        self.masks = nn.ModuleList(_mask(width) for _ in range(blocks - 1))
        self.reconstruct = nn.Sequential(
            _conv(blocks * width, 3 * width),
            nn.ReLU(inplace=True),
            _conv(3 * width, width),
            nn.ReLU(inplace=True),
            _conv(width, 1),
        )

    def forward(self, spikes: Tensor) -> Reconstruction:
        """Return the reconstruction from spikes [B, 41, H, W] of 0 and 1, float."""
        batch, _, height, width = spikes.shape
        padded, top, left = _pad(spikes)
        blocks = torch.stack([padded[:, s : s + BLOCK] for s in BLOCK_STARTS])  # [5, B, 13, H, W]
        features, estimates = self.extract(blocks.flatten(0, 1))
        pyramid = [level.unflatten(0, (-1, batch)) for level in self.align.pyramid(features)]  # each [5, B, width, ...]
        outer = [k for k in range(len(BLOCK_STARTS)) if k != MIDDLE]
        reference = [level[MIDDLE] for level in pyramid]
        aligned = self.align(
            [level[outer].flatten(0, 1) for level in pyramid],
            [level.expand(len(outer), -1, -1, -1, -1).flatten(0, 1) for level in reference],
        ).unflatten(0, (-1, batch))
        trusted = [x * mask(torch.cat([x, reference[0]], dim=1)) for x, mask in zip(aligned, self.masks, strict=True)]
        rate = self.reconstruct(torch.cat([*trusted[:MIDDLE], reference[0], *trusted[MIDDLE:]], dim=1))[:, 0]
        estimates = estimates.unflatten(0, (-1, batch)).transpose(0, 1)
        rows, columns = slice(top, top + height), slice(left, left + width)
        return Reconstruction(rate[:, rows, columns], estimates[..., rows, columns])


def on_device(network: Spk2ImgNet, device: str) -> Spk2ImgNet:
    """Move the network to `device`, channels last in memory: twice as fast as channels first on the CPU."""
    return network.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]


def _pad(x: Tensor) -> tuple[Tensor, int, int]:
    """Return [..., H, W] mirrored at its sides up to multiples of four, and the rows above and columns left added."""
    before = [-x.shape[dim] % 4 // 2 for dim in (-2, -1)]
    for dim, start in zip((-2, -1), before, strict=True):
        n = x.shape[dim]
        if n % 4:
            index = mirrored(np.arange(-start, n - start + -n % 4), n)
            x = x.index_select(dim, torch.from_numpy(index).to(x.device))
    return x, before[0], before[1]
