"""The matching network: one extractor for all views, coarse descriptors, and a head that refines a match.

Coarse cells are 4 px wide. Two cells match with the probability that each is the other's best partner among all cells
of the other view (dual softmax, as in LoFTR). A match is then refined: the fine feature at the point is compared with
those around the partner, the mean over their softmax gives the place to about a pixel, and a small network the rest,
with the error that it expects.

The point of a coarse cell is the centre of its pixel (2, 2): a pixel's centre has a depth, a corner has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from spike4dgs.method.matching.config import MatcherConfig
from spike4dgs.method.matching.window_inputs import CHANNELS
from spike4dgs.method.msdi.extractor import initialize

COARSE, FINE = 4, 2  # px, widths of the cells
POINT = 2.5  # px from a coarse cell's corner to its point, both ways
_SLOPE = 0.1
_PATCH = 8  # px, of the coarsest features


@dataclass(frozen=True, eq=False)
class Features:
    """Features of N views of H x W px; h, w are the coarse cells whose points lie inside."""

    coarse: Tensor  # [N, C, h, w] of unit length
    fine: Tensor  # [N, F, 2 h', 2 w'], with h' >= h, w' >= w: cells that reach beyond the image are there
    size: tuple[int, int]  # H, W


@dataclass(frozen=True, eq=False)
class Refined:
    """K refined matches."""

    uv: Tensor  # [K, 2] px, in the second view
    log_error: Tensor  # [K] logarithm of the error that is expected of each coordinate, px
    first: Tensor  # [K, 2] px, before the last layer: the mean over the softmax


class Extractor(nn.Module):
    """A U-Net of few layers: features at the image's size, coarse and fine ones."""

    def __init__(self, config: MatcherConfig) -> None:
        super().__init__()
        a, b, c, d = config.widths
        self.stem = nn.Conv2d(CHANNELS, a, 3, padding=1)
        self.to_two = nn.Sequential(down(a, b), Residual(b))
        self.to_four = nn.Sequential(down(b, c), Residual(c))
        self.to_eight = nn.Sequential(down(c, d), Residual(d), Residual(d))
        self.from_eighth, self.coarse = nn.Conv2d(d, c, 1), Residual(c)
        self.describe = nn.Conv2d(c, c, 1)
        self.from_quarter, self.from_half = nn.Conv2d(c, config.fine, 1), nn.Conv2d(b, config.fine, 1)
        self.fine = nn.Sequential(Residual(config.fine), nn.Conv2d(config.fine, config.fine, 1))
        initialize(self)

    def forward(self, inputs: Tensor) -> Features:
        """Return the features of `inputs` [N, 4, H, W]."""
        height, width = inputs.shape[2:]
        x = functional.pad(inputs, (0, -width % _PATCH, 0, -height % _PATCH))
        half = self.to_two(functional.leaky_relu(self.stem(x), _SLOPE))
        quarter = self.to_four(half)
        eighth = functional.interpolate(self.from_eighth(self.to_eight(quarter)), scale_factor=2.0, mode="nearest")
        quarter = self.coarse(quarter + eighth)
        up = functional.interpolate(self.from_quarter(quarter), scale_factor=2.0, mode="nearest")
        cells = (height + 1) // COARSE, (width + 1) // COARSE  # the point is 2.5 px from the corner: within if 3 px are
        coarse = functional.normalize(self.describe(quarter)[:, :, : cells[0], : cells[1]], dim=1)
        return Features(coarse, self.fine(self.from_half(half) + up), (height, width))


class Matcher(nn.Module):
    """The networks of matching: see the module."""

    def __init__(self, config: MatcherConfig) -> None:
        super().__init__()
        self.config = config
        self.extractor = Extractor(config)
        self.sharpness = nn.Parameter(torch.tensor(2.5))  # logarithm of the similarities' factor
        self.fine_sharpness = nn.Parameter(torch.tensor(0.0))
        side = 2 * config.reach
        self.refine = nn.Sequential(
            nn.Linear(2 * config.fine + side**2, config.hidden),
            nn.LeakyReLU(_SLOPE),
            nn.Linear(config.hidden, config.hidden),
            nn.LeakyReLU(_SLOPE),
            nn.Linear(config.hidden, 3),
        )
        nn.init.zeros_(self.refine[-1].weight)  # type: ignore[arg-type]
        nn.init.zeros_(self.refine[-1].bias)  # type: ignore[arg-type]

    def factors(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """Return what cells of `a` and `b` [P, C, h, w] are as alike as the product of: [P, h w, C] and [P, C, h w]."""
        return self.sharpness.exp() * a.flatten(2).transpose(1, 2), b.flatten(2)

    def log_probabilities(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the logarithms [P, h w, h w] that cells of `a` and `b` [P, C, h, w] are each other's best partners."""
        rows, columns = self.factors(a, b)
        similar = rows @ columns
        return functional.log_softmax(similar, dim=2) + functional.log_softmax(similar, dim=1)

    def refined(self, a: Tensor, b: Tensor, at: Tensor, near: Tensor, views: tuple[Tensor, Tensor]) -> Refined:
        """Return where in view b the points of view a are.

        Args:
            a, b: fine features [N, F, y, x] of all views.
            at: [K, 2] px, points in the first views; near: [K, 2] px, corners of fine cells near their partners.
            views: [K] each, number of each point's first and second view in `a` and `b`.
        """
        reach = self.config.reach
        query = sample(a, views[0], at)  # [K, F]
        steps = (torch.arange(2 * reach, device=at.device) - reach + 0.5) * FINE
        offsets = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).reshape(-1, 2).to(near)  # x first
        around = sample(b, views[1].repeat_interleave(len(offsets)), (near[:, None] + offsets).reshape(-1, 2))
        around = around.unflatten(0, (len(at), len(offsets)))  # [K, S, F]
        similar = torch.einsum("kf,ksf->ks", query, around) * self.fine_sharpness.exp() / query.shape[1] ** 0.5
        first = near + similar.softmax(dim=1) @ offsets
        there = sample(b, views[1], first.detach())
        out = self.refine(torch.cat([query, there, similar], dim=1))
        return Refined(first.detach() + out[:, :2], out[:, 2], first)


def sample(features: Tensor, view: Tensor, at: Tensor) -> Tensor:
    """Return fine features [K, F] of [N, F, y, x] at points `at` [K, 2] px of views [K].

    They are bilinear between the middles of cells; beyond those of the border the nearest counts.
    """
    rows, columns = features.shape[2:]
    x, y = (at / FINE - 0.5).unbind(dim=1)
    x, y = x.clamp(0, columns - 1), y.clamp(0, rows - 1)
    x0, y0 = x.floor().clamp(max=max(columns - 2, 0)), y.floor().clamp(max=max(rows - 2, 0))
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    flat = features.permute(0, 2, 3, 1).reshape(-1, features.shape[1])
    corner = (view * rows + y0.long()) * columns + x0.long()
    right, below = min(1, columns - 1), columns * min(1, rows - 1)
    top = flat[corner] * (1 - fx) + flat[corner + right] * fx
    bottom = flat[corner + below] * (1 - fx) + flat[corner + below + right] * fx
    return top * (1 - fy) + bottom * fy


def points_of_cells(rows: int, columns: int, device: torch.device | str = "cpu") -> Tensor:
    """Return the points [rows columns, 2] of coarse cells in px, x first, row by row."""
    y, x = torch.meshgrid(torch.arange(rows, device=device), torch.arange(columns, device=device), indexing="ij")
    return torch.stack([x, y], dim=-1).reshape(-1, 2) * float(COARSE) + POINT


def middle_of_cell(uv: Tensor) -> Tensor:
    """Return the middles [K, 2] of the coarse cells in which points lie, px."""
    return ((uv / COARSE).floor() + 0.5) * COARSE


class Residual(nn.Module):
    """Two convolutions beside the identity; the second begins at a fraction, so that depth does not add up."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = nn.Conv2d(width, width, 3, padding=1), nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Return [N, width, H, W] of the same size."""
        y = self.second(functional.leaky_relu(self.first(x), _SLOPE))
        return functional.leaky_relu(x + 0.5 * y, _SLOPE)


def down(inputs: int, outputs: int) -> nn.Module:
    """Return a layer that halves an image's sides, rounded up."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, stride=2, padding=1), nn.LeakyReLU(_SLOPE))
