"""A grid of the space that is empty at all times, where samples need no network (Mueller et al. 2022)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.settings import Settings
from spike4dgs.method.starts.plane_sweep import pixels_of

DECAY = 0.8  # of the remembered density at each update of a cell: matter that has gone is forgotten after a few updates


@dataclass(frozen=True)
class OccupancySettings(Settings):
    """Size and updates of the grid (prefix `occupancy`)."""

    cells: int = 48
    begin: float = 0.2  # share of the steps before the first update: the field knows nothing yet
    every: int = 16  # steps between two updates
    share: float = 0.15  # of the cells in one update
    least: float = 0.02  # opacity of a cell below which it counts as empty


class Occupancy(nn.Module):
    """A grid over a box that remembers the largest density seen lately in each cell, at any time of the clip.

    A cell is empty where that density, along the cell's diagonal, hides less than `least` of what is behind, in the
    cell and in its neighbours; and where it is no candidate. Candidates are cells near a first point, and cells that
    may hold something that moves: a network says nothing of space that it was never trained in, and would fill it with
    fog, sample after sample. Outside the box nothing is empty, and nothing moves.
    """

    def __init__(self, low: Tensor, high: Tensor, cells: int, least: float) -> None:
        super().__init__()
        self.low: Tensor
        self.high: Tensor
        self.density: Tensor
        self.occupied: Tensor
        self.candidates: Tensor
        self.movable: Tensor
        self.cells, self.least = cells, least
        self.register_buffer("low", low.float().clone())
        self.register_buffer("high", high.float().clone())
        self.register_buffer("density", torch.full((cells**3,), torch.inf))  # 1/m; inf: not evaluated yet
        for mask in ("occupied", "candidates", "movable"):
            self.register_buffer(mask, torch.ones(cells**3, dtype=torch.bool))

    def forward(self, points: Tensor) -> Tensor:
        """Return whether there may be something at points [..., 3] m."""
        inside, index = self.cell_of(points)
        return ~inside | self.occupied[index]

    def moves(self, points: Tensor) -> Tensor:
        """Return whether something at points [..., 3] m may be moving."""
        inside, index = self.cell_of(points)
        return inside & self.movable[index]

    def cell_of(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return whether points [..., 3] m are inside the box, and the flat index of the nearest cell."""
        unit = (points - self.low) / (self.high - self.low)
        x, y, z = (unit * self.cells).long().clamp(0, self.cells - 1).unbind(-1)
        return ((unit >= 0) & (unit <= 1)).all(-1), (x * self.cells + y) * self.cells + z

    def positions(self, index: Tensor, within: Tensor | float = 0.5) -> Tensor:
        """Return points [N, 3] m in the cells of flat `index` [N], at `within` [N, 3] in [0, 1] of each cell."""
        n = self.cells
        corner = torch.stack([index // n**2, index // n % n, index % n], -1)
        return self.low + (corner + within) / n * (self.high - self.low)

    def begin(self, points: Tensor, movable: Tensor) -> None:
        """Start with candidates around points [N, 3] m and in the cells of the mask `movable` [cells^3]."""
        inside, index = self.cell_of(points)
        found = movable.clone()
        found[index[inside]] = True
        self.movable.copy_(self._grown(movable))
        self.candidates.copy_(self._grown(found))
        self.occupied.copy_(self.candidates)

    @torch.no_grad()
    def update(self, density: Callable[[Tensor], Tensor], share: float, generator: torch.Generator) -> None:
        """Evaluate a random point in each of a random `share` of the candidates.

        `density` gives 1/m [N] at points [N, 3] m.
        """
        cells = torch.nonzero(self.candidates)[:, 0]
        count = round(share * len(cells))
        index = cells[torch.randperm(len(cells), generator=generator)[:count].to(cells.device)]
        found = density(self.positions(index, torch.rand(len(index), 3, generator=generator).to(self.low)))
        old = self.density[index]
        self.density[index] = torch.where(old.isinf(), found, torch.maximum(DECAY * old, found))
        diagonal = float((self.high - self.low).norm()) / self.cells
        self.occupied.copy_(self.candidates & self._grown(-torch.expm1(-self.density * diagonal) > self.least))

    def _grown(self, mask: Tensor) -> Tensor:
        """Return a mask [cells^3] and the neighbours of its cells."""
        cube = mask.view(1, 1, *[self.cells] * 3)
        return functional.max_pool3d(cube.float(), 3, 1, 1).flatten() > 0


def may_move(grid: Occupancy, cameras: Sequence[Camera], moving: NDArray[np.bool_]) -> Tensor:
    """Return the cells [cells^3] whose centres lie on changing pixels `moving` [C, H, W] in all views that see them."""
    centers = grid.positions(torch.arange(grid.cells**3, device=grid.low.device)).double().cpu().numpy()
    seen, static = np.zeros(len(centers), bool), np.zeros(len(centers), bool)
    for camera, mask in zip(cameras, moving, strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            inside, u, v, _ = pixels_of(camera, centers)
        seen |= inside
        static |= inside & ~mask[v, u]
    return torch.from_numpy(seen & ~static).to(grid.low.device)
