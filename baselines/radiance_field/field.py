"""The radiance field (Mildenhall et al. 2020): positional encoding, network, and the deformation in front of it."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from spike4dgs.method.motion.hexplane import HexPlane, HexPlaneShape
from spike4dgs.method.motion.mlp import perceptron

THIN = 3.0  # at first a path of one unit is 5 % opaque


def encode_position(x: Tensor, frequencies: int) -> Tensor:
    """Return (x, sin(2^k pi x), cos(2^k pi x) for k < frequencies) [N, D (1 + 2 frequencies)] for x [N, D]."""
    scale = math.pi * 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angle = (x[:, None, :] * scale[:, None]).flatten(1)  # [N, frequencies * D]
    return torch.cat([x, angle.sin(), angle.cos()], -1)


def encoded_size(dimensions: int, frequencies: int) -> int:
    """Return the length of an encoded position."""
    return dimensions * (1 + 2 * frequencies)


class Field(nn.Module):
    """Density and gray value at a point, seen from a direction. Points are in [-1, 1]^3.

    As published: `depth` layers of `width`, the encoded point fed in again in the middle; density from the last one;
    the value from a further layer of half the width that sees the direction too. Three things differ. Density is
    softplus(raw - 3) and not relu(raw), which a small network can lose for good. A value is sigmoid times `brightest`,
    because a spike camera tells radiances above white apart up to one spike per tick. Values are gray.
    """

    def __init__(
        self,
        depth: int,
        width: int,
        position_frequencies: int,
        direction_frequencies: int,
        brightest: float,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.position_frequencies, self.brightest = position_frequencies, brightest
        point, view = encoded_size(3, position_frequencies), encoded_size(3, direction_frequencies)
        self.skip = depth // 2  # the layer that sees the point again: 4 of 8
        sizes = [point] + [width] * depth
        extra = [point if 0 < i == self.skip else 0 for i in range(depth)]
        self.trunk = nn.ModuleList([nn.Linear(sizes[i] + extra[i], width) for i in range(depth)])
        self.density = nn.Linear(width, 1)
        self.feature = nn.Linear(width, width)
        self.branch = nn.Linear(width + view, width // 2)
        self.value = nn.Linear(width // 2, 1)
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
                nn.init.zeros_(layer.bias)

    def _trunk(self, x: Tensor) -> Tensor:
        point = encode_position(x, self.position_frequencies)
        h = point
        for i, layer in enumerate(self.trunk):
            h = layer(torch.cat([h, point], -1) if 0 < i == self.skip else h).relu()
        return h

    def density_rows(self, x: Tensor) -> Tensor:
        """Return density [N, 1] at points [N, 3]."""
        return functional.softplus(self.density(self._trunk(x)) - THIN)

    def rows(self, x: Tensor, view: Tensor) -> Tensor:
        """Return density and value [N, 2] at points [N, 3] seen along encoded directions `view` [N, E]."""
        h = self._trunk(x)
        density = functional.softplus(self.density(h) - THIN)
        seen = self.branch(torch.cat([self.feature(h), view], -1)).relu()
        return torch.cat([density, self.brightest * self.value(seen).sigmoid()], -1)


class Deformation(nn.Module):
    """The canonical point of a point seen at time t: x + D(H(x, t)), as 4DGS moves Gaussians.

    H is the HexPlane of x and t over a box, D a linear layer and one head (ReLU, linear, ReLU, linear), whose last
    layer starts at zero: nothing moves at first. Points move in units of `scale` metres.
    """

    def __init__(
        self, shape: HexPlaneShape, low: Tensor, high: Tensor, scale: float, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.scale = scale
        self.planes = HexPlane(shape, low, high, generator)
        w = shape.width
        self.first, self.hidden = nn.Linear(shape.features * len(shape.spatial), w), nn.Linear(w, w)
        for layer in (self.first, self.hidden):
            nn.init.xavier_uniform_(layer.weight, generator=generator)
            nn.init.zeros_(layer.bias)
        self.last = nn.Linear(w, 3)
        for parameter in self.last.parameters():
            nn.init.zeros_(parameter)

    def forward(self, points: Tensor, t: float) -> Tensor:
        """Return canonical points [N, 3] m of points [N, 3] m seen at t in [0, 1]."""
        return points + self.scale * perceptron(self.planes(points, t), self.mlp())

    def mlp(self) -> list[Tensor]:
        """Return weights and biases of the linear layers."""
        return [*self.first.parameters(), *self.hidden.parameters(), *self.last.parameters()]
