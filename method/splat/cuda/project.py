"""Projection into all views at once, by differentiable torch operations in float64, on any device.

The formulas are those of `reference.py`; its docstring has the symbols. Here only Gaussians that are seen are kept, as
M rows of (view, Gaussian), and each becomes what the kernels need: a centre and whitened coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from spike4dgs.method.splat.reference import rotation_matrices
from spike4dgs.method.splat.types import ALPHA_MIN, FRUSTUM_MARGIN, Splats, Views


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


def project(splats: Splats, views: Views, antialiased: bool, near: float, eps2d: float) -> Seen:
    """Project Gaussians into views; all tensors on one device. See `render` for the arguments."""
    means, quats, scales, opacities = (t.double() for t in splats.geometry)
    w2c, K = views.w2c.double(), views.K.double()
    p = means @ w2c[:, :3, :3].transpose(1, 2) + w2c[:, None, :3, 3]  # [C, N, 3]
    exists = (quats.square().sum(-1) > 0) & (opacities >= ALPHA_MIN)
    view, index = torch.nonzero((p[..., 2] >= near) & exists, as_tuple=True)
    axes = rotation_matrices(torch.where(exists[:, None], quats, quats.new_tensor([1.0, 0, 0, 0]))) * scales[:, None]
    p, f, c = p[view, index], K[:, [0, 1], [0, 1]][view], K[:, :2, 2][view]
    z = p[:, 2:]
    slope = p[:, :2] / z  # [M, 2] tangent of the viewing angle
    image = p.new_tensor([views.width, views.height])
    margin = FRUSTUM_MARGIN * 0.5 * image / f
    inside = torch.minimum(torch.maximum(slope, -c / f - margin), (image - c) / f + margin)
    J = torch.cat([torch.diag_embed(f / z), (-f * inside / z)[:, :, None]], -1)  # [M, 2, 3]
    half = J @ (w2c[:, None, :3, :3] @ axes)[view, index]
    b0, b1 = half.unbind(1)
    det_sharp = torch.linalg.cross(b0, b1).square().sum(-1)
    xx, xy, yy = (b0 * b0).sum(-1), (b0 * b1).sum(-1), (b1 * b1).sum(-1)
    det = det_sharp + eps2d * (xx + yy) + eps2d**2
    xx, yy = xx + eps2d, yy + eps2d
    center, opacity = f * slope + c, opacities[index]
    with torch.no_grad():
        share = (det_sharp / det).sqrt() if antialiased else torch.ones_like(det)
        reach = 2 * (255 * opacity * share).clamp(min=1).log()
        extent = (reach[:, None] * torch.stack([xx, yy], -1)).sqrt()  # [M, 2] half sides of the visible box
        first = torch.ceil(center - extent - 0.5).clamp(min=0)
        last = torch.minimum(torch.floor(center + extent + 0.5), image)
        visible = (opacity * share >= ALPHA_MIN) & (det > 0) & torch.isfinite(det) & (first < last).all(-1)
        keep = torch.nonzero(visible)[:, 0]
        box = torch.stack([first, last], -1)[keep].flatten(1).long()
    xx, xy, det, opacity = (t.index_select(0, keep) for t in (xx, xy, det, opacity))
    if antialiased:  # after the selection: the root's slope is infinite at 0
        opacity = opacity * (det_sharp.index_select(0, keep) / det).sqrt()
    shape = torch.stack([xy / xx, (0.5 / xx).sqrt(), (0.5 * xx / det).sqrt(), opacity], -1)
    center, depth = center.index_select(0, keep), z[:, 0].index_select(0, keep)
    return Seen(view[keep], index[keep], center, shape, depth, box, extent[keep].amax(-1))
