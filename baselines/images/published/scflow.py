"""SCFlow: optical flow between two windows of spikes, and windows that are averaged along it.

Hu, Zhao, Ding, Ma, Shi, Xiong, Huang: Optical flow estimation for spiking camera, CVPR 2022. Windows of 25 ticks, ten
ticks apart, pass a shared encoder of four levels. From the coarsest level down, the second window's features are warped
by the flow so far, correlated with the first's over 9x9 displacements, and a densely connected estimator adds to the
flow. Windows may be aligned along an earlier flow first; here there is none, and they are taken as they are.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, interpolate, leaky_relu, pad

from spike4dgs.baselines.images.published.networks import SLOPE, padded

TICKS, APART = 25, 10  # of a window; between two windows
_REACH = 4  # px of the correlation, to each side
_CHANNELS = (32, 32, 64, 96, 128)


def warp(images: Tensor, flow: Tensor) -> Tensor:
    """Return images [N, C, H, W] sampled at x + flow [N, 2, H, W] px (right, down); edges repeat."""
    height, width = images.shape[-2:]
    y, x = torch.meshgrid(
        torch.arange(height, device=flow.device), torch.arange(width, device=flow.device), indexing="ij"
    )
    at = torch.stack((x, y)) + flow
    size = torch.tensor([max(width - 1, 1), max(height - 1, 1)], device=flow.device).view(1, 2, 1, 1)
    grid = (2 * at / size - 1).permute(0, 2, 3, 1)
    return grid_sample(images, grid, padding_mode="border", align_corners=True)


def correlation(first: Tensor, second: Tensor) -> Tensor:
    """Return the mean product of features [N, C, H, W] at 9x9 displacements [N, 81, H, W], rows of them first."""
    height, width = first.shape[-2:]
    around = pad(second, (_REACH,) * 4)
    shifts = [(dy, dx) for dy in range(2 * _REACH + 1) for dx in range(2 * _REACH + 1)]
    return torch.stack([(first * around[..., y : y + height, x : x + width]).mean(1) for y, x in shifts], 1)


def _convolution(inputs: int, outputs: int, size: int = 3, stride: int = 1, activated: bool = True) -> nn.Sequential:
    layer = nn.Conv2d(inputs, outputs, size, stride, size // 2)
    return nn.Sequential(layer, nn.LeakyReLU(SLOPE)) if activated else nn.Sequential(layer)


class _Representation(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv_s1, self.conv_s2 = _convolution(TICKS, 32), _convolution(32, 32)

    def forward(self, spikes: Tensor) -> Tensor:
        found: Tensor = self.conv_s2(self.conv_s1(spikes))
        return found


class _Encoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        levels = enumerate(zip(_CHANNELS, _CHANNELS[1:], strict=False))
        self.conv_list = nn.ModuleList(
            nn.Sequential(_convolution(a, b, stride=2 if level else 1), _convolution(b, b)) for level, (a, b) in levels
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        """Return the features of each level, the coarsest first."""
        levels = []
        for convolutions in self.conv_list:
            levels.append(x := convolutions(x))
        return levels[::-1]


class _Estimator(nn.Module):
    """Convolutions that each see all that came before."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.conv1 = _convolution(inputs, 96)
        self.conv2 = _convolution(inputs + 96, 64)
        self.conv3 = _convolution(inputs + 96 + 64, 32)
        self.conv4 = _convolution(inputs + 96 + 64 + 32, 2, activated=False)

    def forward(self, x: Tensor) -> Tensor:
        for convolution in (self.conv1, self.conv2, self.conv3):
            x = torch.cat((convolution(x), x), 1)
        found: Tensor = self.conv4(x)
        return found


class ScFlow(nn.Module):
    """SCFlow between windows of 25 ticks whose middles are ten ticks apart."""

    def __init__(self) -> None:
        super().__init__()
        self.spike_representation, self.feature_encoder = _Representation(), _Encoder()
        self.flow_estimators = _Estimator(32 + (2 * _REACH + 1) ** 2 + 2)
        self.conv_1x1 = nn.ModuleList(_convolution(c, 32, 1, activated=False) for c in _CHANNELS[:0:-1])

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Return the flow [N, 2, H, W] in px (right, down) from one window [N, 25, H, W] to the other."""
        height, width = first.shape[-2:]
        pyramids = [self.feature_encoder(self.spike_representation(padded(x, 16))) for x in (first, second)]
        flow = first.new_zeros(len(first), 2, *pyramids[0][0].shape[-2:])
        for level, (x1, x2) in enumerate(zip(*pyramids, strict=True)):
            if level:
                flow = interpolate(2 * flow, scale_factor=2.0, mode="bilinear", align_corners=True)
                x2 = warp(x2, flow)
            matched = leaky_relu(correlation(x1, x2), SLOPE)
            flow = flow + self.flow_estimators(torch.cat((matched, self.conv_1x1[level](x1), flow), 1))
        return flow[..., :height, :width]


def mean_along(spikes: Tensor, flow: Tensor) -> Tensor:
    """Return the mean [H, W] of ticks [T, H, W], each sampled where flow [2, H, W] in px a tick has come by its middle.

    The flow begins with the tick in the middle of them.
    """
    offsets = torch.arange(len(spikes), device=spikes.device) - len(spikes) // 2 + 0.5  # the middle of each tick
    return warp(spikes[:, None], offsets.view(-1, 1, 1, 1) * flow).mean((0, 1))
