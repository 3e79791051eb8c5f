"""SSML, SSIR and SpikeCLIP: networks from a window of spikes to an image, with the names of their authors' tensors.

Each takes spikes [1, C, H, W] float32 of 0 and 1, upright and centred on the tick, and returns a relative intensity
[1, 1, H, W]; SSIR takes several windows. Sides that a network's strides do not divide are padded by repeating the edge,
and the image is cut to size.

SSML       Chen, Duan, Yu, Xiong, Huang: Self-supervised mutual learning for dynamic scene reconstruction of spiking
           camera, IJCAI 2022. The branch without a blind spot: a U-Net of three levels without biases.
SSIR       Zhao, Xiong, Zhang, Yu, Zhu, Ma, Huang: Spike camera image reconstruction using deep spiking neural networks,
           IEEE TCSVT 2023. Parametric leaky neurons: what a layer returns is 0 or 1. Its authors train and judge it
           on windows 20 ticks apart, from one to the next of which the neurons keep their potentials; the image of the
           first, in which they are at rest, has no part in their loss.
SpikeCLIP  Chen, Chen, Yu, Huang: Rethinking high-speed image reconstruction framework with spike camera, AAAI 2025.
           The light reconstruction network: five convolutions of 50 sums of four ticks.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, leaky_relu, max_pool2d, pad

SLOPE = 0.1  # of the leaky rectifiers
_THRESHOLD = 1.0  # of a neuron's potential
STEP = 20  # ticks between windows of a network that sees several


def padded(images: Tensor, multiple: int) -> Tensor:
    """Return images [N, C, H, W] whose sides are multiples of a number: edges repeat at the right and below."""
    height, width = images.shape[-2:]
    return pad(images, (0, -width % multiple, 0, -height % multiple), "replicate")


class _Convolution(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, padding=1, padding_mode="replicate", bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return leaky_relu(self.conv(x), SLOPE)


def _convolutions(*channels: int) -> nn.Sequential:
    """Return convolutions conv1, conv2, ... from each number of channels to the next."""
    block = nn.Sequential()
    for number, (inputs, outputs) in enumerate(pairwise(channels), start=1):
        block.add_module(f"conv{number}", _Convolution(inputs, outputs))
    return block


class Ssml(nn.Module):
    """SSML's branch without a blind spot, on 41 ticks."""

    ticks, windows = 41, 1

    def __init__(self) -> None:
        super().__init__()
        self.enc1 = _convolutions(self.ticks, 48, 48, 48)
        self.enc2 = _convolutions(48, 48, 48, 48)
        self.enc3 = _convolutions(48, 96, 96, 48)
        self.dec2 = _convolutions(96, 96, 96, 96, 96)
        self.dec1 = _convolutions(96 + self.ticks, 96, 96, 96, 1)

    def forward(self, spikes: Tensor) -> Tensor:
        """Return the intensity [N, 1, H, W] of spikes [N, 41, H, W]."""
        height, width = spikes.shape[-2:]
        x = padded(spikes, 4)
        half = max_pool2d(self.enc1(x), 2)
        quarter = self.enc3(max_pool2d(self.enc2(half), 2))
        half = self.dec2(torch.cat((interpolate(quarter, scale_factor=2.0), half), 1))
        found: Tensor = self.dec1(torch.cat((interpolate(half, scale_factor=2.0), x), 1))
        return found[..., :height, :width]


class _Neuron(nn.Module):
    """Parametric leaky neurons that begin at rest, and go back to it where they fire (Fang et al., ICCV 2021)."""

    def __init__(self) -> None:
        super().__init__()
        self.w = nn.Parameter(torch.zeros(()))

    def forward(self, x: Tensor) -> Tensor:
        """Return 1 where a neuron fires, of inputs [T, C, H, W] one after the other, else 0."""
        leak, potential, fired = self.w.sigmoid(), torch.zeros_like(x[0]), torch.empty_like(x)
        for step, seen in enumerate(x):
            potential = potential + (seen - potential) * leak
            fired[step] = potential >= _THRESHOLD
            potential = potential * (1 - fired[step])
        return fired


def _normalised(convolution: nn.Conv2d | nn.ConvTranspose2d, channels: int, *more: nn.Module) -> nn.Sequential:
    return nn.Sequential(convolution, nn.BatchNorm2d(channels), *more)


class _Layer(nn.Module):
    """A convolution, its normalisation and neurons."""

    def __init__(self, convolution: nn.Conv2d | nn.ConvTranspose2d, channels: int) -> None:
        super().__init__()
        self.layer = _normalised(convolution, channels, _Neuron())

    def forward(self, x: Tensor) -> Tensor:
        found: Tensor = self.layer(x)
        return found


class _Bottleneck(nn.Module):
    """Three spiking layers of a quarter of the channels, added to what comes in."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = channels // 4
        self.conv1 = _normalised(nn.Conv2d(channels, inner, 1, bias=False), inner)
        self.conv2 = _normalised(nn.Conv2d(inner, inner, 3, padding=1, bias=False), inner)
        self.conv3 = _normalised(nn.Conv2d(inner, channels, 1, bias=False), channels)
        self.sn1, self.sn2, self.sn3 = _Neuron(), _Neuron(), _Neuron()

    def forward(self, x: Tensor) -> Tensor:
        found: Tensor = self.sn3(self.conv3(self.sn2(self.conv2(self.sn1(self.conv1(x))))))
        return found + x


class _Head(nn.Module):
    """Four convolutions without activation: the first one pads for all."""

    def __init__(self, inputs: int, inner: int) -> None:
        super().__init__()
        self.conv1 = _normalised(nn.Conv2d(inputs, inner, 3, padding=4, bias=False), inner)
        self.conv2 = _normalised(nn.Conv2d(inner, inner, 3, bias=False), inner)
        self.conv3 = _normalised(nn.Conv2d(inner, inner, 3, bias=False), inner)
        self.conv4 = nn.Conv2d(inner, 1, 3, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        found: Tensor = self.conv4(self.conv3(self.conv2(self.conv1(x))))
        return found


class Ssir(nn.Module):
    """SSIR on windows of 41 ticks. It is for inference alone: neurons have no surrogate gradient."""

    ticks, windows = 41, 4

    def __init__(self) -> None:
        super().__init__()
        self.static_conv = _Layer(nn.Conv2d(self.ticks, 128, 3, padding=1, bias=False), 128)
        self.enc1 = _Layer(nn.Conv2d(128, 128, 3, stride=2, padding=1, bias=False), 128)
        self.eres1 = _Bottleneck(128)
        self.dec3 = _Layer(nn.ConvTranspose2d(128, 64, 4, stride=2, padding=1, bias=False), 64)
        self.pred3 = _Head(64, 32)

    def forward(self, spikes: Tensor) -> Tensor:
        """Return the intensity [1, 1, H, W] of the last of windows [T, 41, H, W] that begin `STEP` ticks apart."""
        height, width = spikes.shape[-2:]
        found: Tensor = self.pred3(self.dec3(self.eres1(self.enc1(self.static_conv(padded(spikes, 2)))))[-1:])
        return found[..., :height, :width]


class SpikeClip(nn.Sequential):
    """SpikeCLIP's light reconstruction network on 200 ticks."""

    ticks, windows = 200, 1

    def __init__(self) -> None:
        channels = (50, 64, 128, 64, 16)
        hidden = [nn.Sequential(nn.Conv2d(a, b, 3, padding=1), nn.ReLU()) for a, b in pairwise(channels)]
        super().__init__(*hidden, nn.Conv2d(channels[-1], 1, 3, padding=1))

    def forward(self, spikes: Tensor) -> Tensor:
        """Return the intensity [N, 1, H, W] of spikes [N, 200, H, W]."""
        sums = spikes.unflatten(1, (50, 4)).sum(2)
        found: Tensor = super().forward(sums)
        return found
