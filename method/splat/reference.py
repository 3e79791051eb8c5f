"""The slow, obvious renderer: float64, every pixel against every Gaussian, gradients by autograd.

It defines the semantics that the other back ends are tested against (those of gsplat 1.5):

    p = R m + t,  culled where p_z < NEAR, and where a lens shows nothing
    S2 = J R S R^T J^T + eps2d I,  J the projection's Jacobian at p, at most 0.3 half images outside the image
        with a lens J = diag(f) D [[1, 0, -u], [0, 1, -v]] / p_z,  D its derivatives at (u, v) = (p_x, p_y) / p_z
    alpha = min(0.999, o exp(-d^T S2^-1 d / 2)),  skipped where below 1/255
    compensated: o *= sqrt(|S2 - eps2d I| / |S2|)
    front to back by float32 depth, ties by index:  C += T alpha c,  T *= 1 - alpha,  until T would fall to 1e-4

Memory grows as pixels x Gaussians. Not differentiated: the visibility decisions and the order.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from spike4dgs.method.splat.lens import FRUSTUM_MARGIN, bent, bent_slopes
from spike4dgs.method.splat.types import (
    ALPHA_MAX,
    ALPHA_MIN,
    NEAR,
    T_MIN,
    PixelFilter,
    RenderOutput,
    Splats,
    Views,
    require_finite,
    require_finite_cameras,
)


@dataclass(frozen=True, eq=False)
class Projection:
    """The M visible Gaussians of one view, front to back."""

    index: Tensor  # [M] into the N Gaussians
    center: Tensor  # [M, 2] px
    cov: Tensor  # [M, 3] xx, xy, yy of the blurred 2D covariance, px^2
    det: Tensor  # [M] its determinant
    opacity: Tensor  # [M]
    depth: Tensor  # [M]
    radius: Tensor  # [M] px


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return the rotation matrices [M, 3, 3] of quaternions wxyz [M, 4] of any length."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def project(
    splats: Splats,
    w2c: Tensor,
    K: Tensor,
    size: tuple[int, int],
    pixel_filter: PixelFilter,
    lens: Tensor | None = None,
) -> Projection:
    """Project float64 Gaussians into one view of size (width, height), through a lens [10] where it has one."""
    eps2d, antialiased = pixel_filter.variance, pixel_filter.compensated
    p = splats.means @ w2c[:3, :3].T + w2c[:3, 3]  # [N, 3]
    index = torch.nonzero((p[:, 2] >= NEAR) & (splats.quats.square().sum(-1) > 0))[:, 0]
    index = index[torch.argsort(p[index, 2].detach().float(), stable=True)]
    p, f, c = p[index], K[[0, 1], [0, 1]], K[:2, 2]
    z = p[:, 2:]
    slope = p[:, :2] / z  # [M, 2] tangent of the viewing angle
    image = torch.tensor(size, dtype=p.dtype)
    if lens is None:
        margin = FRUSTUM_MARGIN * 0.5 * image / f
        inside = torch.minimum(torch.maximum(slope, -c / f - margin), (image - c) / f + margin)
        J = torch.cat([torch.diag_embed(f / z), (-f * inside / z)[:, :, None]], -1)  # [M, 2, 3]
        shown, center = torch.ones_like(z[:, 0], dtype=torch.bool), f * slope + c
    else:
        inside = torch.minimum(torch.maximum(slope, lens[[5, 7]]), lens[[6, 8]])
        flat = torch.cat([torch.diag_embed(1 / z.expand(-1, 2)), (-inside / z)[:, :, None]], -1)
        J = f[:, None] * bent_slopes(inside, lens) @ flat
        lying, shown = bent(slope, lens)
        center = f * lying + c
    half = J @ w2c[:3, :3] @ (rotation_matrices(splats.quats[index]) * splats.scales[index, None, :])
    cov = half @ half.transpose(1, 2)  # [M, 2, 2]
    # The determinant as a sum of squares (Cauchy-Binet): xx * yy - xy^2 would cancel for needles.
    det_sharp = torch.linalg.cross(half[:, 0], half[:, 1]).square().sum(-1)
    xx, xy, yy = cov[:, 0, 0] + eps2d, cov[:, 0, 1], cov[:, 1, 1] + eps2d
    det = det_sharp + eps2d * (cov[:, 0, 0] + cov[:, 1, 1]) + eps2d**2
    opacity = splats.opacities[index]
    share = (det_sharp / det).detach().sqrt() if antialiased else torch.ones_like(det)  # that a compensation leaves
    keep = (opacity >= ALPHA_MIN) & (opacity * share >= ALPHA_MIN) & (det > 0) & shown
    reach = 2 * (255 * opacity.detach() * share).clamp(min=1).log()
    extent = (reach[:, None] * torch.stack([xx, yy], -1).detach()).sqrt()  # [M, 2] half sides of the visible box
    first = torch.ceil(center.detach() - extent - 0.5).clamp(min=0)
    last = torch.minimum(torch.floor(center.detach() + extent - 0.5), image - 1)
    keep = torch.nonzero(keep & (first <= last).all(-1))[:, 0]
    opacity = opacity.index_select(0, keep)
    if antialiased:  # after the selection: the root's slope is infinite at 0
        opacity = opacity * (det_sharp[keep] / det[keep]).sqrt()
    cov3 = torch.stack([xx, xy, yy], -1)[keep]
    return Projection(index[keep], center[keep], cov3, det[keep], opacity, p[keep, 2], extent[keep].amax(-1))


def project_view(splats: Splats, views: Views, view: int, pixel_filter: PixelFilter) -> Projection:
    """Project float64 Gaussians into one of some views."""
    lens = None if views.lenses is None else views.lenses[view].double()
    size = views.width, views.height
    return project(splats, views.w2c[view].double(), views.K[view].double(), size, pixel_filter, lens)


def alphas(view: Projection, center: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return the unclamped alpha [M, H*W] of each Gaussian at each pixel, and whether it is composited there (bool)."""
    width, height = size
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    xx, xy = view.cov[:, :1], view.cov[:, 1:2]
    dx, dy = x.reshape(1, -1) - center[:, :1], y.reshape(1, -1) - center[:, 1:]
    # d^T S2^-1 d by completing the square: the share of x, and that of y's distance from the ridge line
    distance2 = dx**2 / xx + (dy - xy / xx * dx) ** 2 * xx / view.det[:, None]
    raw = view.opacity[:, None] * torch.exp(-0.5 * distance2)
    with torch.no_grad():
        hit = raw >= ALPHA_MIN
        after = torch.cumprod(torch.where(hit, 1 - raw.clamp(max=ALPHA_MAX), 1.0), 0)  # T behind each Gaussian
    return raw, hit & (after > T_MIN)


def composite(view: Projection, center: Tensor, colors: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Blend colors [M, F] front to back -> image [H, W, F], alpha [H, W]."""
    raw, live = alphas(view, center, size)
    alpha = torch.where(live, torch.where(raw > ALPHA_MAX, ALPHA_MAX, raw), 0.0)
    after = torch.cumprod(1 - alpha, 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    image = torch.einsum("mp,mf->pf", before * alpha, colors)
    opaque = 1 - after[-1] if len(colors) else torch.zeros(size[0] * size[1], dtype=colors.dtype)
    return image.reshape(size[1], size[0], -1), opaque.reshape(size[1], size[0])


def render_reference(splats: Splats, views: Views, pixel_filter: PixelFilter, depth: bool) -> RenderOutput:
    """Render with the back end "reference": see `render`. Computes in float64, returns the dtype of the colours."""
    require_finite(splats)
    require_finite_cameras(views)
    dtype, size, n = splats.colors.dtype, (views.width, views.height), len(splats)
    wide = Splats(*(t.double() for t in splats.tensors))
    seen = [project_view(wide, views, c, pixel_filter) for c in range(len(views))]
    blank = torch.zeros(n, 2, dtype=torch.float64)
    means2d = torch.stack([blank.index_copy(0, s.index, s.center) for s in seen])
    if means2d.requires_grad:
        means2d.retain_grad()
    radii = torch.stack([torch.zeros(n).index_copy(0, s.index, s.radius.detach().float()) for s in seen])
    images, opaque = [], []
    for c, s in enumerate(seen):
        layers = torch.cat([wide.colors[s.index], s.depth[:, None]], -1)
        image, alpha = composite(s, means2d[c][s.index], layers, size)
        images.append(image)
        opaque.append(alpha)
    stack = torch.stack(images).to(dtype)
    far = stack[..., -1] if depth else None
    return RenderOutput(stack[..., :-1], torch.stack(opaque).to(dtype), far, radii, means2d)
