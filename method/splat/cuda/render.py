"""Back end "cuda": torch projects and sorts, the kernels composite, and all of it is on the tensors' device.

The results are those of `reference.py`: projected in float64, composited in float32. Equal inputs give equal bits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from spike4dgs.benchmark.environment import missing_rasterizer
from spike4dgs.benchmark.errors import problem
from spike4dgs.method.splat.cuda.prepare import (
    TILE,
    Grid,
    Lists,
    Pairs,
    Seen,
    launch,
    make_pairs,
    project,
    simulated,
    sort_pairs,
)
from spike4dgs.method.splat.types import (
    PixelFilter,
    RenderOutput,
    Splats,
    Views,
    require_finite,
    require_finite_cameras,
)

THREADS = TILE * TILE  # of a block: one for each pixel
MAX_CHANNELS = 4  # of one kernel call, which keeps them in registers


@dataclass(frozen=True, eq=False)
class Behind:
    """What the rows of a render lie in front of: B rows without gradient, and the images where nothing else is."""

    records: Tensor  # [B, 6] float64
    layers: Tensor  # [B, F] float32
    image: Tensor  # [C, F, H, W]
    alpha: Tensor  # [C, H, W]


@dataclass(frozen=True, eq=False)
class Job:
    """What the kernels need beside the M differentiable rows, which follow those of `behind`."""

    lists: Lists
    starts: Tensor  # [M + 1], see Pairs
    behind: Behind | None = None


class _Blend(torch.autograd.Function):
    """Records [M, 6] float64 and layers [M, F] float32 in, image [C, F, H, W] and alpha [C, H, W] out."""

    @staticmethod
    def forward(ctx: Any, records: Tensor, layers: Tensor, job: Job) -> tuple[Tensor, Tensor]:
        grid, lists, behind = job.lists.grid, job.lists, job.behind
        records, layers = records.detach().contiguous(), layers.detach().contiguous()
        channels, size = layers.shape[1], (grid.height, grid.width)
        if behind is None:
            image, alpha = layers.new_empty(grid.views, channels, *size), layers.new_empty(grid.views, *size)
        else:
            records, layers = torch.cat([behind.records, records]), torch.cat([behind.layers, layers])
            image, alpha = behind.image.clone(memory_format=torch.contiguous_format), behind.alpha.clone()
        forward, _, _ = _kernels(channels)
        arguments = (records, layers, lists.rows, lists.offsets, lists.tiles, grid.across, grid.down, image, alpha)
        launch(forward, len(lists.tiles), THREADS, records.device, *arguments)
        ctx.save_for_backward(records, layers, image, alpha)
        ctx.job = job
        return image, alpha

    @staticmethod
    def backward(ctx: Any, d_image: Tensor, d_alpha: Tensor) -> tuple[Tensor, Tensor, None]:  # type: ignore[override]
        records, layers, image, alpha = ctx.saved_tensors
        lists, starts = ctx.job.lists, ctx.job.starts
        _, backward, sum_pairs = _kernels(layers.shape[1])
        values = 6 + layers.shape[1]
        sums = layers.new_zeros(max(int(lists.slots.shape[0]), 1), values)
        launch(
            backward, len(lists.tiles), THREADS, records.device, records, layers, lists.rows, lists.slots,
            lists.offsets, lists.tiles, lists.grid.across, lists.grid.down, image, alpha, d_image.contiguous(),
            d_alpha.contiguous(), sums,
        )  # fmt: skip
        own = len(starts) - 1
        totals = records.new_zeros(own, values)
        launch(sum_pairs, -(-totals.numel() // THREADS), THREADS, records.device, sums, starts, totals)
        return _chain(records[len(records) - own :], totals[:, :6]), totals[:, 6:].float(), None


def _chain(records: Tensor, moments: Tensor) -> Tensor:
    """Return the gradient [M, 6] of the records from the sums of s, s xi, s eta, s xi^2, s xi eta, s eta^2.

    ln alpha = ln opacity - xi^2 - eta^2 with xi = a (x - cx), eta = b ((y - cy) - slope (x - cx)).
    """
    _, _, slope, a, b, opacity = records.unbind(-1)
    s, s_xi, s_eta, s_xi_xi, s_xi_eta, s_eta_eta = moments.unbind(-1)
    d_center = (2 * a * s_xi - 2 * b * slope * s_eta, 2 * b * s_eta)
    return torch.stack([*d_center, 2 * b / a * s_xi_eta, -2 * s_xi_xi / a, -2 * s_eta_eta / b, s / opacity], -1)


@cache
def _kernels(channels: int) -> tuple[Any, Any, Any]:
    """Return the forward, the backward and the sum kernel."""
    from spike4dgs.method.splat.cuda.kernels import blend_kernels, sum_pairs

    return (*blend_kernels(channels), sum_pairs)


def blend(records: Tensor, layers: Tensor, job: Job) -> tuple[Tensor, Tensor]:
    """Composite any number of layers, some at a time; the alpha image is the first call's."""
    images, alphas = [], []
    for first in range(0, layers.shape[1], MAX_CHANNELS):
        some = slice(first, first + MAX_CHANNELS)
        part = job
        if job.behind is not None:
            behind = replace(job.behind, layers=job.behind.layers[:, some], image=job.behind.image[:, some])
            part = replace(job, behind=behind)
        image, alpha = _Blend.apply(records, layers[:, some], part)
        images.append(image)
        alphas.append(alpha)
    return torch.cat(images, 1), alphas[0]


@dataclass(frozen=True, eq=False)
class Projected:
    """The visible Gaussians of some splats in some views, ready for the kernels, and their statistics."""

    grid: Grid
    seen: Seen
    pairs: Pairs
    records: Tensor  # [M, 6] float64
    radii: Tensor  # [C, N] px
    means2d: Tensor  # [C, N, 2] px


def project_splats(splats: Splats, views: Views, pixel_filter: PixelFilter) -> Projected:
    """Project splats and make the tensor that receives dL/dmeans2d. Raises UserError for NaN."""
    if not torch.isfinite(
        torch.stack([t.detach().sum().double() for t in (*splats.tensors, views.w2c, views.K)]).sum()
    ):
        require_finite(splats)
        require_finite_cameras(views)
    seen = project(splats, views, pixel_filter)
    wide = any(t.dtype == torch.float64 for t in splats.geometry)
    shape, at = (len(views), len(splats)), (seen.view, seen.index)
    means2d = seen.center.new_zeros(*shape, 2, dtype=torch.float64 if wide else torch.float32)
    means2d[at] = seen.center.detach().to(means2d)
    radii = seen.radius.new_zeros(shape, dtype=torch.float32)
    radii[at] = seen.radius.float()
    center = seen.center
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*splats.tensors, views.w2c)):
        means2d.requires_grad_()
        center = center + (means2d - means2d.detach())[at].double()  # adds 0, and receives the centre's gradient
    grid = Grid(len(views), views.width, views.height)
    return Projected(grid, seen, make_pairs(seen, grid), torch.cat([center, seen.shape], -1), radii, means2d)


def render_cuda(splats: Splats, views: Views, pixel_filter: PixelFilter, depth: bool) -> RenderOutput:
    """Render with the back end "cuda": see `render` for the arguments."""
    device = splats.means.device
    if not simulated():
        if device.type != "cuda":
            raise problem("back end cuda", "tensors on a CUDA device", str(device), "move them with .cuda()")
        if missing := missing_rasterizer(str(device)):
            fix = f"{missing.fix}, or move the tensors to the CPU"
            raise problem("back end cuda", missing.expected, missing.found, fix)
    p = project_splats(splats, views.to(device), pixel_filter)
    layers = splats.colors[p.seen.index].float()
    if depth:
        layers = torch.cat([layers, p.seen.depth[:, None].float()], -1)
    slots = torch.arange(len(p.pairs.keys), device=device)
    lists = sort_pairs(p.grid, p.pairs.keys, p.pairs.rows, slots)
    image, alpha = blend(p.records, layers, Job(lists, p.pairs.starts))
    image = image.permute(0, 2, 3, 1)
    image, far = (image[..., :-1], image[..., -1]) if depth else (image, None)
    return RenderOutput(image, alpha, far, p.radii, p.means2d)
