"""Hard cases of the rasteriser: images and gradients beside the float64 reference, and its refusal of NaN."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from spike4dgs.benchmark.environment import device_type
from spike4dgs.benchmark.hard_cases.case import Case, Outcome, Setting, refused
from spike4dgs.method.hard_cases import splat_scenes
from spike4dgs.method.hard_cases.splat_scenes import changed, random_splats, views
from spike4dgs.method.splat import RenderOutput, Splats, Views, render
from spike4dgs.method.splat.reference import cutoff_margin

NAMES = ("means", "quats", "scales", "opacities", "colors", "w2c", "means2d")
ON_CUTOFF = 1e-4  # relative distance to alpha = 1/255 or T = 1e-4 within which float32 may decide otherwise
MOST_ON_CUTOFF = 0.005  # of the pixels; more, and a comparison says little
IMAGE_TOLERANCE, GRADIENT_TOLERANCE = 1e-4, 1e-3
_FLOOR = 1e-9  # of a gradient's norm: below it the relative error is that of rounding noise

_SCENES: dict[str, tuple[Callable[[], tuple[Splats, Views]], str]] = {
    "random": (lambda: (random_splats(150, 3, seed=20), views()), "150 Gaussians of all sizes in three colours"),
    "behind": (splat_scenes.behind, "Gaussians behind the camera, huge ones among them"),
    "near-plane": (splat_scenes.near_plane, "centres from behind the camera to just beyond the near plane"),
    "needles": (splat_scenes.needles, "needles, one axis 10,000 times the others"),
    "pancakes": (splat_scenes.pancakes, "flat discs, a third of them seen edge-on"),
    "tiny-and-huge": (splat_scenes.tiny_and_huge, "standard deviations of 1e-6 and 1e3, also within one Gaussian"),
    "opacities": (splat_scenes.opacities, "opacities of 0, 1/255, almost 1 and 1"),
    "equal-depths": (splat_scenes.equal_depths, "all centres at one depth, pairs at one point"),
    "off-screen": (splat_scenes.off_screen, "Gaussians beside and above the image, and behind the camera"),
    "empty": (splat_scenes.nothing, "no Gaussian at all"),
    "far-origin": (splat_scenes.far_origin, "a scene and its cameras 10 km from the origin, float64 inputs"),
    "opaque-stack": (splat_scenes.opaque_stack, "400 opaque Gaussians behind each other"),
    "zero-quaternions": (splat_scenes.zero_quaternions, "a third of the quaternions are zero"),
    "crowd": (splat_scenes.crowd, "100,000 faint Gaussians in front of one pixel"),
}


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
    splats: Splats, v: Views, backend: str, keep: Tensor, depth: bool, device: str = "cpu", **options: object
) -> tuple[RenderOutput, dict[str, Tensor]]:
    """Render and pull back a fixed random cotangent of every output; keep [C, H, W] masks pixels on a cut-off."""
    leaves = [t.detach().to(device, copy=True).requires_grad_() for t in (*splats.geometry, splats.colors, v.w2c)]
    seen = Views(leaves[5], v.K, v.width, v.height)
    out = render(Splats(*leaves[:5]), seen, backend=backend, depth=depth, **options)  # type: ignore[arg-type]
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
    keep = cutoff_margin(splats, v, antialiased=antialiased) > ON_CUTOFF
    expected, wanted = differentiate(splats, v, "reference", keep, depth, antialiased=antialiased)
    found, got = differentiate(splats, v, backend, keep, depth, device, antialiased=antialiased)
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


@lru_cache(maxsize=4)  # a scene's two rows follow each other
def _parities(name: str, device: str) -> tuple[Parity, Parity]:
    splats, v = _SCENES[name][0]()
    backend = device_type(device)
    return parity(splats, v, backend, device), parity(splats, v, backend, device, depth=True, antialiased=True)


def cases() -> list[Case]:
    """Return the cases of the rasteriser, an image and a gradient of each scene."""
    found = []
    for name, (_, asked) in _SCENES.items():
        for kind, tolerance in (("image", IMAGE_TOLERANCE), ("gradient", GRADIENT_TOLERANCE)):
            case = Case(
                id=f"method/splat/{name}-{kind}",
                asked=f"{kind} of {asked}",
                twin="every pixel against every Gaussian, float64, autograd",
                unit="of white" if kind == "image" else "relative L2",
                tolerance=tolerance,
                run=_image(name) if kind == "image" else _gradient(name),
                on_device=True,
                seconds=(4.0 if name == "crowd" else 0.5) if kind == "image" else 0.01,
            )
            found.append(case)
    refusal = Case(
        id="method/splat/refuse",
        asked="NaN and infinity in each of the five tensors",
        twin="the contract: one clear error each",
        unit="inputs taken",
        tolerance=0,
        run=_refused,
        on_device=True,
    )
    return [*found, refusal]


def _image(name: str) -> Callable[[Setting], Outcome]:
    def run(setting: Setting) -> Outcome:
        both = _parities(name, setting.device)
        cut = max(p.on_cutoff for p in both)
        text = f"{cut:.2%} of the pixels on a cut-off, not compared" if cut else "all pixels compared"
        if not all(p.visible for p in both):
            return Outcome("other Gaussians are visible", float("inf"))
        if cut > MOST_ON_CUTOFF:
            return Outcome(f"{text}: too many to say anything", float("inf"))
        return Outcome(text, max(p.image for p in both), all(p.finite_image for p in both))

    return run


def _gradient(name: str) -> Callable[[Setting], Outcome]:
    def run(setting: Setting) -> Outcome:
        both = _parities(name, setting.device)
        first = max(both, key=lambda p: p.gradient)
        text = f"seven gradients; the worst is that of {first.worst_leaf}"
        return Outcome(text, first.gradient, all(p.finite_gradient for p in both))

    return run


def _refused(setting: Setting) -> Outcome:
    splats, v = random_splats(5, seed=setting.seed), views(1)
    moved = changed(splats, **{n: getattr(splats, n).to(setting.device) for n in NAMES[:5]})
    calls = {}
    for name in NAMES[:5]:
        for value in (float("nan"), float("inf")):
            broken = getattr(moved, name).clone()
            broken[3] = value
            bad = changed(moved, **{name: broken})
            calls[f"{value} in {name}"] = lambda bad=bad: render(bad, v, backend=device_type(setting.device))  # type: ignore[misc, arg-type]
    return refused(calls)
