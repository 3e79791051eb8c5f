"""The tiles' lists of Gaussians, nearest first, by torch: one key for each Gaussian-tile pair, and one sort."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

TILE = 16  # pixels


@dataclass(frozen=True)
class Grid:
    """The tiles of `views` images of one size. A tile's number is view * (across * down) + row * across + column."""

    views: int
    width: int
    height: int

    @property
    def across(self) -> int:
        """Tiles in a row."""
        return -(-self.width // TILE)

    @property
    def down(self) -> int:
        """Rows of tiles."""
        return -(-self.height // TILE)

    def __len__(self) -> int:
        return self.views * self.across * self.down


@dataclass(frozen=True, eq=False)
class Pairs:
    """P Gaussian-tile pairs, in the order of the Gaussians."""

    keys: Tensor  # [P] int64: tile number << 32 | bits of the float32 depth
    rows: Tensor  # [P] the Gaussian's row
    starts: Tensor  # [M + 1] the pairs of row m are starts[m]:starts[m + 1]


def make_pairs(view: Tensor, box: Tensor, depth: Tensor, grid: Grid) -> Pairs:
    """Return the pairs of M Gaussians.

    view [M]: image of each; box [M, 4]: first and last + 1 pixel column, then row; depth [M], positive.
    """
    first, last = box[:, 0::2] // TILE, (box[:, 1::2] - 1) // TILE + 1  # [M, 2] tiles in x and y
    width, height = (last - first).unbind(-1)
    starts = torch.zeros(len(view) + 1, dtype=torch.int64, device=view.device)
    torch.cumsum(width * height, 0, out=starts[1:])
    total = int(starts[-1])
    rows = torch.repeat_interleave(torch.arange(len(view), device=view.device), width * height, output_size=total)
    inside = torch.arange(total, device=view.device) - starts[rows]
    wide = width[rows]
    column, row = first[rows, 0] + inside % wide, first[rows, 1] + inside // wide
    tile = (view[rows] * grid.down + row) * grid.across + column
    bits = depth.detach().float().view(torch.int32).long()[rows]
    return Pairs((tile << 32) | bits, rows, starts)


@dataclass(frozen=True, eq=False)
class Lists:
    """The pairs, tile by tile and nearest first, ties by row; and the tiles that are rendered."""

    grid: Grid
    keys: Tensor  # [P] int64, see Pairs
    rows: Tensor  # [P] the Gaussian's row in the kernels' records
    slots: Tensor  # [P] the pair's row in the gradient records, or -1
    offsets: Tensor  # [tiles + 1] the list of tile t is offsets[t]:offsets[t + 1]
    tiles: Tensor  # [K] the numbers of the tiles to render


def all_tiles(grid: Grid, device: torch.device) -> Tensor:
    """Return the numbers of all tiles."""
    return torch.arange(len(grid), device=device)


def sort_pairs(grid: Grid, keys: Tensor, rows: Tensor, slots: Tensor, tiles: Tensor) -> Lists:
    """Return the lists of pairs in any order of tiles; pairs of one tile and depth keep their order."""
    ordered, order = torch.sort(keys, stable=True)
    bounds = torch.arange(len(grid) + 1, device=keys.device) << 32
    return Lists(grid, ordered, rows[order], slots[order], torch.searchsorted(ordered, bounds), tiles)
