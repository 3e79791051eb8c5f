"""A back end of the rasteriser against the float64 reference: images, and gradients of all inputs."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from spike4dgs.method.splat import PixelFilter, RenderOutput, Splats, Views, render
from spike4dgs.studies.speed_error.splat import cutoff_margin

NAMES = ("means", "quats", "scales", "opacities", "colors", "w2c", "means2d")
ON_CUTOFF = 1e-4  # relative distance to alpha = 1/255 or T = 1e-4 within which float32 may decide otherwise
MOST_ON_CUTOFF = 0.005  # of the pixels; more, and a comparison says little
IMAGE_TOLERANCE, GRADIENT_TOLERANCE = 1e-4, 1e-3
_FLOOR = 1e-9  # of a gradient's norm: below it the relative error is that of rounding noise


@dataclass(frozen=True)
class Parity:
    """How far a back end is from the float64 reference, over images with and without compensated filter and depth."""

    image: float  # worst difference of image, alpha and depth (in units of the scene's size) off the cut-offs
    gradient: float  # worst relative L2 difference over the seven leaves
    worst_leaf: str
    on_cutoff: float  # share of pixels that are not compared
    visible: bool  # the same Gaussians are visible
    finite_image: bool
    finite_gradient: bool


def differentiate(
    splats: Splats, v: Views, backend: str, keep: Tensor, depth: bool, device: str = "cpu", compensated: bool = False
) -> tuple[RenderOutput, dict[str, Tensor]]:
    """Render and pull back a fixed random cotangent of every output; keep [C, H, W] masks pixels on a cut-off."""
    leaves = [t.detach().to(device, copy=True).requires_grad_() for t in (*splats.tensors, v.w2c)]
    seen = replace(v, w2c=leaves[5])
    f = PixelFilter(compensated=compensated)
    out = render(Splats(*leaves[:5]), seen, f, backend=backend, depth=depth)  # type: ignore[arg-type]
    g = torch.Generator().manual_seed(0)
    loss = torch.zeros((), dtype=torch.float64)
    for layer, weight in ((out.image, 1.0), (out.alpha[..., None], 1.0), (out.depth, 0.2)):
        if layer is not None:
            flat = layer.reshape(*keep.shape, -1).cpu()
            loss = loss + weight * (flat * keep[..., None] * torch.randn(flat.shape, generator=g)).sum()
    loss.backward()  # type: ignore[no-untyped-call]
    gradients = [t.grad if t.grad is not None else torch.zeros_like(t) for t in (*leaves, out.means2d)]
    return out, {name: g.cpu() for name, g in zip(NAMES, gradients, strict=True)}


def parity(
    splats: Splats, v: Views, backend: str, device: str = "cpu", *, depth: bool = False, antialiased: bool = False
) -> Parity:
    """Return how far a back end's images and gradients are from the reference's."""
    keep = cutoff_margin(splats, v, PixelFilter(compensated=antialiased)) > ON_CUTOFF
    expected, wanted = differentiate(splats, v, "reference", keep, depth, compensated=antialiased)
    found, got = differentiate(splats, v, backend, keep, depth, device, antialiased)
    error, finite = 0.0, True
    for name in ("image", "alpha", "depth") if depth else ("image", "alpha"):
        a, b = getattr(expected, name).detach(), getattr(found, name).detach().cpu()
        scale = max(1.0, float(splats.means.abs().max())) if name == "depth" and len(splats) else 1.0
        finite &= a.shape == b.shape and bool(torch.isfinite(b).all())
        error = max(error, float((a - b).abs().reshape(*keep.shape, -1).amax(-1)[keep].max()) / scale)
    relative = {name: _relative(got[name], wanted[name]) for name in NAMES}
    leaf = max(relative, key=lambda n: relative[n])
    smooth = all(bool(torch.isfinite(g).all()) for g in got.values())
    visible = torch.equal(expected.visible, found.visible.cpu())
    return Parity(error, relative[leaf], leaf, 1 - float(keep.double().mean()), visible, finite, smooth)


def _relative(found: Tensor, expected: Tensor) -> float:
    off, size = (found - expected).double().norm(), expected.double().norm()  # 1e-300 is 0 in float32
    return float((off - _FLOOR).clamp(min=0) / (size + 1e-300))


def compare(
    splats: Splats, v: Views, backend: str, device: str = "cpu", *, depth: bool = False, antialiased: bool = False
) -> None:
    """Assert that a back end on a device gives the reference's images and gradients."""
    found = parity(splats, v, backend, device, depth=depth, antialiased=antialiased)
    assert found.on_cutoff <= MOST_ON_CUTOFF, "too many pixels are on a cut-off"
    assert found.visible and found.finite_image and found.finite_gradient
    assert found.image <= IMAGE_TOLERANCE
    assert found.gradient <= GRADIENT_TOLERANCE, found.worst_leaf
