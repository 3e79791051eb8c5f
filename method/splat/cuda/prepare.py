"""What the CUDA back end does first: project by torch, list the tiles' Gaussians, launch kernels on torch's stream.

With NUMBA_ENABLE_CUDASIM=1 numba runs a kernel as Python threads on NumPy arrays. That shows the arithmetic on a
machine without a device, slowly, and nothing else: neither the compilation nor the speed.

Projection into all views at once is differentiable, in float64, on any device. The formulas are those of
`reference.py`; its docstring has the symbols. Here only Gaussians that are seen are kept, as M rows of (view,
Gaussian), and each becomes what the kernels need: a centre and whitened coordinates.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from numba.core import config
from torch import Tensor

from spike4dgs.benchmark.environment import numba_stream
from spike4dgs.method.splat.lens import FRUSTUM_MARGIN, bent, bent_slopes
from spike4dgs.method.splat.reference import rotation_matrices
from spike4dgs.method.splat.types import ALPHA_MIN, NEAR, PixelFilter, Splats, Views

# A small image has few tiles. That a grid could be larger is no news to the user.
warnings.filterwarnings("ignore", message=".*Grid size")


def simulated() -> bool:
    """Return whether numba runs CUDA kernels in its simulator, which takes tensors of the CPU."""
    return bool(config.ENABLE_CUDASIM)  # type: ignore[attr-defined, unused-ignore]


def launch(kernel: Any, blocks: int, threads: int, device: torch.device, *arguments: Any) -> None:
    """Run `kernel` on a grid of `blocks` x `threads`; tensors among the arguments are passed as arrays."""
    if blocks == 0:
        return
    if simulated():
        kernel[blocks, threads](*(a.detach().numpy() if isinstance(a, Tensor) else a for a in arguments))
        return
    from numba import cuda

    with numba_stream(device) as stream:
        arrays = (cuda.as_cuda_array(a.detach(), sync=False) if isinstance(a, Tensor) else a for a in arguments)
        with naming(kernel):
            kernel[blocks, threads, stream](*arrays)
            if os.environ.get("CUDA_LAUNCH_BLOCKING") == "1":
                torch.cuda.synchronize(device)


@contextmanager
def naming(kernel: Any) -> Iterator[None]:
    """Add a kernel's name to what fails inside.

    An access out of bounds is reported by a later call, except under CUDA_LAUNCH_BLOCKING=1.
    """
    try:
        yield
    except Exception as e:
        e.add_note(f"in the kernel {kernel.py_func.__qualname__}")
        raise


@dataclass(frozen=True, eq=False)
class Seen:
    """The M pairs of a view and a Gaussian that is visible in it, in the order of views, then Gaussians."""

    view: Tensor  # [M] int64
    index: Tensor  # [M] int64 into the N Gaussians
    center: Tensor  # [M, 2] px
    shape: Tensor  # [M, 4] slope, xi scale, eta scale, opacity; see kernels.py
    depth: Tensor  # [M]
    box: Tensor  # [M, 4] int64: first and last + 1 pixel column, then row, whose centres the ellipse may cover
    radius: Tensor  # [M] px


def project(splats: Splats, views: Views, pixel_filter: PixelFilter) -> Seen:
    """Project Gaussians into views; all tensors on one device.

    No constant or index list comes from the host: each such copy would wait for the device.
    """
    eps2d, antialiased = pixel_filter.variance, pixel_filter.compensated
    means, quats, scales, opacities = (t.double() for t in splats.geometry)
    w2c, K = views.w2c.double(), views.K.double()
    turn = w2c[:, None, :3, :3]
    p = product(turn, means[:, :, None])[..., 0] + w2c[:, None, :3, 3]  # [C, N, 3]
    exists = (quats.square().sum(-1) > 0) & (opacities >= ALPHA_MIN)
    view, index = torch.nonzero((p[..., 2] >= NEAR) & exists, as_tuple=True)
    axes = rotation_matrices(torch.where(exists[:, None], quats, _row(quats, 1, 0, 0, 0))) * scales[:, None]
    p, f, c = p[view, index], K[:, :2, :2].diagonal(dim1=1, dim2=2)[view], K[:, :2, 2][view]
    z = p[:, 2:]
    slope = p[:, :2] / z  # [M, 2] tangent of the viewing angle
    image = _row(p, views.width, views.height)
    lens = None if views.lenses is None else views.lenses.double()[view]
    if lens is None:
        margin = FRUSTUM_MARGIN * 0.5 * image / f
        inside = torch.minimum(torch.maximum(slope, -c / f - margin), (image - c) / f + margin)
    else:
        inside = torch.minimum(torch.maximum(slope, lens[:, 5:9:2]), lens[:, 6:9:2])
    local = product(turn, axes)[view, index]  # [M, 3, 3] the ellipsoid's axes in the view
    # [M, 2, 3]: the Jacobian of the projection, f/z (1, 0, -slope_x) and f/z (0, 1, -slope_y), times the axes
    half = (f / z)[:, :, None] * (local[:, :2] - inside[:, :, None] * local[:, 2:])
    lying, shown = slope, None
    if lens is not None:
        D = bent_slopes(inside, lens) * f[:, :, None] / f[:, None]
        half = D[:, :, :1] * half[:, :1] + D[:, :, 1:] * half[:, 1:]
        lying, shown = bent(slope, lens)
    b0, b1 = half.unbind(1)
    det_sharp = torch.linalg.cross(b0, b1).square().sum(-1)
    xx, xy, yy = (b0 * b0).sum(-1), (b0 * b1).sum(-1), (b1 * b1).sum(-1)
    det = det_sharp + eps2d * (xx + yy) + eps2d**2
    xx, yy = xx + eps2d, yy + eps2d
    center, opacity = f * lying + c, opacities[index]
    with torch.no_grad():
        share = (det_sharp / det).sqrt() if antialiased else torch.ones_like(det)
        reach = 2 * (255 * opacity * share).clamp(min=1).log()
        extent = (reach[:, None] * torch.stack([xx, yy], -1)).sqrt()  # [M, 2] half sides of the visible box
        first = torch.ceil(center - extent - 0.5).clamp(min=0)
        last = torch.minimum(torch.floor(center + extent + 0.5), image)
        visible = (opacity * share >= ALPHA_MIN) & (det > 0) & torch.isfinite(det) & (first < last).all(-1)
        keep = torch.nonzero(visible if shown is None else visible & shown)[:, 0]
        box = torch.stack([first, last], -1)[keep].flatten(1).long()
    xx, xy, det, opacity = (t.index_select(0, keep) for t in (xx, xy, det, opacity))
    if antialiased:  # after the selection: the root's slope is infinite at 0
        opacity = opacity * (det_sharp.index_select(0, keep) / det).sqrt()
    shape = torch.stack([xy / xx, (0.5 / xx).sqrt(), (0.5 * xx / det).sqrt(), opacity], -1)
    center, depth = center.index_select(0, keep), z[:, 0].index_select(0, keep)
    return Seen(view[keep], index[keep], center, shape, depth, box, extent[keep].amax(-1))


def product(a: Tensor, b: Tensor) -> Tensor:
    """Return a @ b for a [..., 3, 3] and b [..., 3, K], written out.

    A library chooses how it adds up by the number of matrices: the same Gaussian would get other bits among others.
    And it is slow for many small ones.
    """
    x, y, z = (a[..., :, i, None] * b[..., i, None, :] for i in range(3))
    return x + y + z


def _row(like: Tensor, *values: float) -> Tensor:
    """Return numbers as a tensor of the type and on the device of another: each is filled in there."""
    made = like.new_empty(len(values))
    for at, value in enumerate(values):
        made[at].fill_(value)
    return made


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


def make_pairs(seen: Seen, grid: Grid) -> Pairs:
    """Return the pairs of M Gaussians."""
    view, box = seen.view, seen.box
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
    bits = seen.depth.detach().float().view(torch.int32).long()[rows]
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


def sort_pairs(grid: Grid, keys: Tensor, rows: Tensor, slots: Tensor, tiles: Tensor | None = None) -> Lists:
    """Return the lists of pairs in any order of tiles; pairs of one tile and depth keep their order.

    `tiles` are those to render, else all.
    """
    if tiles is None:
        tiles = torch.arange(len(grid), device=keys.device)
    ordered, order = torch.sort(keys, stable=True)
    bounds = torch.arange(len(grid) + 1, device=keys.device) << 32
    return Lists(grid, ordered, rows[order], slots[order], torch.searchsorted(ordered, bounds), tiles)
