"""MSDI's spike feature extractor (eqs. 6, 7) and image generator (eq. 12): a blind-spot network on spikes.

A layer that sees only rows above a pixel runs on the stream in four orientations. Turned back and concatenated, the
four see all around the pixel, and never the pixel itself: a feature is what the neighbours say about it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

_SLOPE = 0.1  # of LeakyReLU


def shift(x: Tensor) -> Tensor:
    """Move [N, C, H, W] down by one row; zeros come in, and the last row is lost."""
    return functional.pad(x, (0, 0, 1, 0))[:, :, :-1]


class ShiftedConv(nn.Module):
    """A 3x3 convolution moved up by one row: the result at row y sees rows y - 2, y - 1 and y; zeros lie outside.

    Zeros, because a mirrored or repeated border would show a pixel to itself.
    """

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, padding=(2, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Return [N, outputs, H, W] from [N, inputs, H, W]."""
        out: Tensor = self.conv(x)[:, :, :-2]
        return out


class UpwardNet(nn.Module):
    """M of eq. 7: features of each pixel from the rows above it.

    With one width it is one shift-based convolution, which sees three rows and columns. Each further width adds a level
    of half the size, on the way down and up again (the blind U-Net of Laine et al. 2019): features are moved down by a
    row before they are halved, so that a block of two rows knows nothing below its upper one.
    """

    def __init__(self, inputs: int, widths: Sequence[int]) -> None:
        super().__init__()
        sources = (inputs, *widths)
        self.down = nn.ModuleList(ShiftedConv(a, b) for a, b in zip(sources, widths, strict=False))
        self.up = nn.ModuleList(ShiftedConv(a + b, b) for a, b in zip(widths[1:], widths, strict=False))

    def forward(self, x: Tensor) -> Tensor:
        """Return [N, widths[0], H, W] from [N, inputs, H, W]; the sides are multiples of 2^(levels - 1)."""
        levels: list[Tensor] = []
        for conv in self.down:
            x = functional.avg_pool2d(shift(levels[-1]), 2) if levels else x
            levels.append(_leaky(conv(x)))
        x = levels[-1]
        for conv, finer in zip(reversed(self.up), reversed(levels[:-1]), strict=True):
            x = functional.interpolate(x, scale_factor=2, mode="nearest")
            x = _leaky(conv(torch.cat([x, finer], dim=1)))
        return shift(x)


def _leaky(x: Tensor) -> Tensor:
    return functional.leaky_relu(x, _SLOPE)


class SpikeExtractor(nn.Module):
    """Eqs. 6 and 7: the upward network on the stream turned by 0, 90, 180 and 270 degrees.

    The gradient of the features at a pixel with respect to the spikes of that pixel is exactly zero.
    """

    def __init__(self, ticks: int, widths: Sequence[int]) -> None:
        super().__init__()
        self.upward = UpwardNet(ticks, widths)
        initialize(self)

    def forward(self, spikes: Tensor) -> Tensor:
        """Return [N, 4 * widths[0], H, W], by direction, from [N, T, H, W]; sides as for `UpwardNet`."""
        turned = [torch.rot90(spikes, k, (2, 3)) for k in range(4)]
        seen: list[Tensor] = [torch.empty(0)] * 4
        for pair in ((0, 2), (1, 3)):  # turns of the same shape run together
            both = self.upward(torch.cat([turned[k] for k in pair]))
            for k, feature in zip(pair, both.chunk(2), strict=True):
                seen[k] = torch.rot90(feature, -k, (2, 3))
        return torch.cat(seen, dim=1)


class ImageGenerator(nn.Module):
    """BCONV of eq. 12: three 1x1 convolutions from a pixel's features to its image.

    With `ticks` > 0 they also get the pixel's own spikes. The published network learns without ground truth and must
    be blind to them; with ground truth there is no need, and no neighbour says as much about a pixel as its own spikes.
    """

    def __init__(self, features: int, widths: tuple[int, int], ticks: int) -> None:
        super().__init__()
        self.ticks = ticks
        self.layers = nn.ModuleList(
            nn.Conv2d(a, b, 1) for a, b in ((features + ticks, widths[0]), (widths[0], widths[1]), (widths[1], 1))
        )
        initialize(self)

    def forward(self, features: Tensor, spikes: Tensor) -> Tensor:
        """Return spikes per tick [N, H, W] from features [N, F, H, W] and spikes [N, T, H, W]."""
        x = torch.cat([features, spikes], dim=1) if self.ticks else features
        for layer in self.layers[:-1]:
            x = _leaky(layer(x))
        out: Tensor = self.layers[-1](x)[:, 0]
        return out


def initialize(network: nn.Module) -> None:
    """Set He's normal weights for LeakyReLU and zero biases: features keep their size from layer to layer."""
    for module in network.modules():
        # Nothing is drawn on torch's device `meta`, yet asking for it there imports torch's compiler: two seconds.
        if isinstance(module, nn.Conv2d) and not module.weight.is_meta:
            nn.init.kaiming_normal_(module.weight, a=_SLOPE)
            if module.bias is not None:
                nn.init.zeros_(module.bias)
