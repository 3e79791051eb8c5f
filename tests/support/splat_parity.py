"""A back end of the rasteriser against the float64 reference: images, and gradients of all inputs."""

from __future__ import annotations

import torch
from torch import Tensor

from spike4dgs.method.splat import RenderOutput, Splats, Views, render
from spike4dgs.method.splat.reference import cutoff_margin

NAMES = ("means", "quats", "scales", "opacities", "colors", "w2c", "means2d")
ON_CUTOFF = 1e-4  # relative distance to alpha = 1/255 or T = 1e-4 within which float32 may decide otherwise


def differentiate(
    splats: Splats, v: Views, backend: str, keep: Tensor, depth: bool, device: str = "cpu", **options: object
) -> tuple[RenderOutput, dict[str, Tensor]]:
    """Render and pull back a fixed random cotangent of every output; keep [C, H, W] masks pixels on a cut-off."""
    leaves = [t.detach().to(device, copy=True).requires_grad_() for t in (*splats.geometry, splats.colors, v.w2c)]
    out = render(Splats(*leaves[:5]), Views(leaves[5], v.K, v.width, v.height), backend=backend, depth=depth, **options)
    g = torch.Generator().manual_seed(0)
    loss = torch.zeros((), dtype=torch.float64)
    for layer, weight in ((out.image, 1.0), (out.alpha[..., None], 1.0), (out.depth, 0.2)):
        if layer is not None:
            layer = layer.reshape(*keep.shape, -1).cpu()
            loss = loss + weight * (layer * keep[..., None] * torch.randn(layer.shape, generator=g)).sum()
    loss.backward()
    return out, {name: t.grad.cpu() for name, t in zip(NAMES, (*leaves, out.means2d), strict=True)}


def compare(
    splats: Splats, v: Views, backend: str, device: str = "cpu", *, depth: bool = False, antialiased: bool = False
) -> None:
    """Assert that a back end on a device gives the reference's images and gradients."""
    margin = cutoff_margin(splats, v, antialiased=antialiased)
    keep = margin > ON_CUTOFF
    assert (~keep).sum() <= 0.005 * keep.numel(), "too many pixels are on a cut-off"
    expected, wanted = differentiate(splats, v, "reference", keep, depth, antialiased=antialiased)
    found, got = differentiate(splats, v, backend, keep, depth, device, antialiased=antialiased)
    assert torch.equal(expected.visible, found.visible.cpu())
    for name in ("image", "alpha", "depth"):
        a, b = getattr(expected, name), getattr(found, name)
        if a is None:
            assert b is None
            continue
        b = b.cpu()
        assert a.shape == b.shape and bool(torch.isfinite(b).all())
        error = (a - b).abs().reshape(*keep.shape, -1).amax(-1)
        scale = max(1.0, float(splats.means.abs().max())) if name == "depth" and len(splats) else 1.0
        assert error[keep].max() <= 1e-4 * scale, name
    for name in NAMES:
        assert bool(torch.isfinite(got[name]).all()), name
        assert (got[name] - wanted[name]).norm() <= 1e-3 * wanted[name].norm() + 1e-9, name
