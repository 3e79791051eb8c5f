"""The radiance field (Mildenhall et al. 2020): positional encoding, network, and the deformation in front of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from spike4dgs.method.motion.hexplane import HexPlane, HexPlaneShape
from spike4dgs.method.motion.mlp import perceptron
from spike4dgs.method.two_threads import on_two_threads

BLOCK = 2048  # rows; 1024 to 4096 take the same time within the noise for layers of 32 to 64

Rows = Callable[..., Tensor]  # row tensors [n, ...] -> [n, K], each row by itself


def _cuts(rows: int) -> list[slice]:
    """Return blocks of equal size, as many for each of two threads."""
    count = 2 * -(-rows // (2 * BLOCK))
    edges = [rows * i // count for i in range(count + 1)]
    return [slice(a, b) for a, b in zip(edges, edges[1:], strict=False)]


def _in_parts(blocks: list[Any], work: Callable[[Any], Any]) -> tuple[list[Any], list[Any]]:
    """Call `work` on each of the blocks, in halves whatever the cores, so that sums keep their order."""
    cut = len(blocks) // 2
    return on_two_threads(lambda part: [work(b) for b in part], blocks[:cut], blocks[cut:])


class _Blocks(torch.autograd.Function):
    """Each block is a graph of its own, made by the forward pass and walked by the backward pass in the same thread."""

    @staticmethod
    def forward(ctx: Any, function: Rows, count: int, *tensors: Tensor) -> Tensor:
        inputs, ctx.parameters = tensors[:count], tensors[count:]
        needed = ctx.needs_input_grad[2 : 2 + count]

        def work(s: slice) -> tuple[list[Tensor], Tensor]:
            leaves = [x[s].detach().requires_grad_(n) for x, n in zip(inputs, needed, strict=True)]
            with torch.enable_grad():
                return leaves, function(*leaves)

        ctx.cuts, ctx.needed = _cuts(len(inputs[0])), needed
        ctx.blocks = [block for part in _in_parts(ctx.cuts, work) for block in part]
        return torch.cat([out.detach() for _, out in ctx.blocks])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        def work(job: tuple[slice, tuple[list[Tensor], Tensor]]) -> tuple[Tensor, ...]:
            s, (leaves, out) = job
            wanted = [leaf for leaf in leaves if leaf.requires_grad]
            return torch.autograd.grad(out, [*wanted, *ctx.parameters], grads[0][s])

        parts = _in_parts(list(zip(ctx.cuts, ctx.blocks, strict=True)), work)
        inputs = sum(ctx.needed)
        rows = iter([torch.cat([g[i] for part in parts for g in part]) for i in range(inputs)])
        per_part = [[sum(g[inputs + i] for g in part) for i in range(len(ctx.parameters))] for part in parts]
        totals = [sum(values) for values in zip(*per_part, strict=True)]
        return None, None, *(next(rows) if n else None for n in ctx.needed), *totals


def in_blocks(function: Rows, inputs: Sequence[Tensor], parameters: Sequence[Tensor]) -> Tensor:
    """Return function(*inputs), whose rows are independent, by blocks; gradients go to `inputs` and `parameters`.

    `parameters` are all leaves that the function uses, and it must use each of them.
    """
    if inputs[0].device.type != "cpu" or not len(inputs[0]):
        return function(*inputs)
    if not torch.is_grad_enabled():
        quiet = torch.no_grad()(lambda s: function(*(x[s] for x in inputs)))  # the mode belongs to the thread
        return torch.cat([out for part in _in_parts(_cuts(len(inputs[0])), quiet) for out in part])
    out: Tensor = _Blocks.apply(function, len(inputs), *inputs, *parameters)
    return out


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
        return points + self.scale * perceptron(self.planes(points, t), self.mlp())[0]

    def mlp(self) -> list[Tensor]:
        """Return weights and biases of the linear layers."""
        return [*self.first.parameters(), *self.hidden.parameters(), *self.last.parameters()]
