"""What the rasteriser leaves out: faint Gaussians, what is behind an opaque pixel, the pixel's shape, bits of exp."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numba.extending import intrinsic
from torch import Tensor

from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.splat.kernels.jit import kernel
from spike4dgs.method.splat.kernels.vector_ir import EXP2_POLYNOMIAL, Lanes, array_data, host_lanes, offset
from spike4dgs.method.splat.reference import project
from spike4dgs.method.splat.types import ALPHA_MAX, ALPHA_MIN, CUSTOMARY, T_MIN, PixelFilter
from spike4dgs.method.torch_state import one_torch_thread
from spike4dgs.studies.kit.measurement import TIMES, Column, Point, Request, Series, compared, max_rms, measurement
from spike4dgs.studies.speed_error.gaussians import random_scene, wide
from spike4dgs.studies.speed_error.splat import GROUP, MAX, RMS

PAIRS = Column("pairs", "Gaussians composited at a pixel, mean")
FINER = 8  # samples across a pixel, of the exact box


@torch.no_grad()
def composited(splats: Splats, views: Views, alpha_min: float, t_min: float) -> tuple[Tensor, float]:
    """Return the image [H*W] in float64, cut at other limits than the rasteriser's, and the mean work at a pixel."""
    opaque = torch.ones(len(splats), dtype=torch.float64)  # so that the projection culls nothing
    size, all_opaque = (views.width, views.height), wide(splats, opacities=opaque)
    view = project(all_opaque, views.w2c[0].double(), views.K[0].double(), size, CUSTOMARY)
    view = replace(view, opacity=splats.opacities.double()[view.index])
    colors, image = all_opaque.colors[view.index, 0], []
    pairs = 0
    for y in range(views.height):  # a row at a time: memory grows as pixels x Gaussians
        raw = _alphas(view.center, view.cov, view.det, view.opacity, y, views.width)
        alpha = torch.where(raw >= alpha_min, raw.clamp(max=ALPHA_MAX), 0.0)
        after = torch.cumprod(1 - alpha, 0)
        live = (alpha > 0) & (after > t_min)
        weight = torch.where(live, alpha * torch.cat([torch.ones_like(after[:1]), after[:-1]]), 0.0)
        image.append(weight.T @ colors)
        pairs += int(live.sum())
    return torch.cat(image), pairs / (views.width * views.height)


def _alphas(center: Tensor, cov: Tensor, det: Tensor, opacity: Tensor, y: int, width: int) -> Tensor:
    """Return the unclamped alpha [M, W] of a row of pixels."""
    dx = torch.arange(width) + 0.5 - center[:, :1]
    dy = y + 0.5 - center[:, 1:]
    xx, xy = cov[:, :1], cov[:, 1:2]
    distance2 = dx**2 / xx + (dy - xy / xx * dx) ** 2 * xx / det[:, None]
    return opacity[:, None] * torch.exp(-0.5 * distance2)


def _cuts(request: Request, limits: dict[str, tuple[float, float]], chosen: str) -> Iterator[Series]:
    """Yield the errors of limits (of alpha, of T) by name; the first is exact."""
    n, size = request.pick((60, (24, 16)), (1000, (64, 40)), (10_000, (100, 63)))
    random, views = random_scene(n, request.seed, *size)
    for name, splats in (
        ("faint", replace(random, opacities=0.2 * random.opacities)),
        ("of all opacities", random),
        ("large and opaque", replace(random, opacities=0.5 + 0.5 * random.opacities, scales=4 * random.scales)),
    ):
        exact, points = None, []
        for title, (alpha_min, t_min) in limits.items():
            with one_torch_thread():
                image, pairs = composited(splats, views, alpha_min, t_min)
            exact = image if exact is None else exact
            values = {"pairs": pairs, **max_rms(image, exact)}
            role: Any = "exact" if image is exact else "chosen" if title == chosen else ""
            points.append(Point(title, values, role))
        yield Series(f"{n} Gaussians, {name}", tuple(points))


@measurement("splat-extent", GROUP, "Rasterizer: faint Gaussians", (PAIRS, MAX, RMS), ("rms", "max"))
def extent(request: Request) -> Iterator[Series]:
    """A Gaussian is left out of a pixel, and of a tile, where its alpha is below 1/255.

    No limit: every Gaussian at every pixel, float64.

    1/255 is 3DGS's limit, and other viewers of a model have it. A fit and its renders are cut alike, so that no error
    of this size is seen in a score: the fit makes up for it. 1/1024 would composite a third more Gaussians for a
    quarter of the error.

    tests/studies/speed_error/test_cuts.py
    """
    fractions = {f"1/{k}": (1 / k, 0.0) for k in (4096, 1024, 255, 64, 16)}
    assert fractions["1/255"][0] == ALPHA_MIN
    yield from _cuts(request, {"0": (1e-300, 0.0), **fractions}, "1/255")


@measurement("splat-opaque", GROUP, "Rasterizer: what is behind opaque pixels", (PAIRS, MAX, RMS), ("rms", "max"))
def transmittance(request: Request) -> Iterator[Series]:
    """A pixel is finished before the Gaussian that would bring its transmittance down to 1e-4.

    No limit, at the same limit of alpha.

    The Gaussian that would reach the limit is left out whole, so that the error is up to the transmittance before it,
    not the limit. 1e-4 keeps that below a step of an 8-bit image; 1e-2 does not, for hardly less work.

    tests/studies/speed_error/test_cuts.py
    """
    powers = {f"1e-{k}": (ALPHA_MIN, 10.0**-k) for k in (6, 4, 3, 2, 1)}
    assert powers["1e-4"][1] == T_MIN
    yield from _cuts(request, {"0": (ALPHA_MIN, 0.0), **powers}, "1e-4")


@measurement("splat-filter", GROUP, "Pixel filter", (*TIMES, MAX, RMS), ("rms", "max"))
def pixel_filter(request: Request) -> Iterator[Series]:
    """A Gaussian of 0.3 px^2 or of 1/12 px^2 is added to each projection, in place of the pixel's square.

    The mean over the pixel's square: 8x8 samples without a filter.

    A square of one pixel has the variance 1/12; compensated it keeps a small Gaussian's light. `spike4dgs-x` uses it.
    0.3 without compensation is customary, and the paper's recipes keep it: its blur helps on noisy images.

    tests/method/splat/test_pixel_filter.py
    """
    n, size = request.pick((60, (24, 16)), (3000, (200, 125)), (20_000, (400, 250)))
    settings = {
        "1/12, compensated": PixelFilter(1 / 12, True),
        "1/12": PixelFilter(1 / 12),
        "0.3, compensated": PixelFilter(0.3, True),
        "0.3": PixelFilter(),
        "none": PixelFilter(1e-6),
    }
    for name, radius in (("smaller than a pixel", 0.3), ("about a pixel", 1.0), ("several pixels", 3.0)):
        splats, views = random_scene(n, request.seed, *size)
        typical = float((splats.scales.mean(1) / splats.means[:, 2]).median()) * size[0]
        splats = replace(splats, scales=splats.scales * (radius / typical))
        fine = Views(views.w2c, views.K.clone(), FINER * views.width, FINER * views.height)
        fine.K[:, :2] *= FINER
        calls = {f"{FINER}x{FINER} samples": partial(_mean_of_samples, splats, fine)}
        calls |= {title: partial(_filtered, splats, views, f) for title, f in settings.items()}
        with torch.no_grad():
            found = compared(f"Gaussians {name}", calls, max_rms, request.pick(1, 5, 9), "1/12, compensated")
        marked = (replace(p, role="chosen") if p.name == "0.3" else p for p in found.points)
        yield replace(found, points=tuple(marked))


def _filtered(splats: Splats, views: Views, f: PixelFilter) -> Tensor:
    return render(splats, views, f, backend="cpu").image[0, :, :, 0]


def _mean_of_samples(splats: Splats, fine: Views) -> Tensor:
    image = _filtered(splats, fine, PixelFilter(1e-6))
    return image.unfold(0, FINER, FINER).unfold(1, FINER, FINER).mean((-1, -2))


def exp2_kernel(polynomial: tuple[float, ...]) -> Any:
    """Return a compiled (source, target) -> None that writes 2**source by the rasteriser's vector code."""
    lanes = host_lanes()

    @intrinsic  # type: ignore[untyped-decorator]
    def one_vector(typing_context: Any, source: Any, target: Any, at: Any) -> Any:
        from numba import types

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            v = Lanes(builder, lanes)
            read, written = (
                offset(builder, array_data(context, builder, signature.args[k], args[k]), args[2]) for k in (0, 1)
            )
            v.store(v.exp2(v.load(read), polynomial), written)
            return context.get_dummy_value()

        return types.none(source, target, types.int64), generate

    @kernel
    def run(source, target):  # type: ignore[no-untyped-def]
        for i in range(0, len(source), lanes):
            one_vector(source, target, i)

    return run


def fitted_polynomial(degree: int) -> tuple[float, ...]:
    """Return a polynomial of 2**x on [-0.5, 0.5] through Chebyshev's nodes, lowest coefficient first."""
    nodes = 0.5 * np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    return tuple(float(c) for c in np.polynomial.Polynomial.fit(nodes, 2**nodes, degree, domain=(-1, 1)).coef)


@measurement(
    "splat-exp",
    GROUP,
    "Rasterizer: exp by a polynomial",
    (
        Column("ns", "time, ns a number"),
        Column("median_ns", "median, ns a number"),
        Column("relative", "largest relative error"),
    ),
    ("relative",),
)
def exponential(request: Request) -> Iterator[Series]:
    """2^x is a polynomial of degree 5 from -0.5 to 0.5; the rest goes into the exponent's bits.

    `numpy.exp2` in float64.

    Degree 5 is the lowest whose error is near that of float32 itself; a higher one costs more, for little.

    tests/studies/speed_error/test_cuts.py
    """
    count = request.pick(1 << 12, 1 << 18, 1 << 20)
    # of alpha from 1/255 to 1, as the kernels ask for: 2^-8 to 1
    x = np.random.default_rng(request.seed).uniform(-8, 0, count).astype(np.float32)
    x64, out = x.astype(np.float64), np.empty_like(x)
    chosen = f"degree {len(EXP2_POLYNOMIAL) - 1}"
    settings = {**{f"degree {d}": fitted_polynomial(d) for d in (2, 3, 4, 6)}, chosen: EXP2_POLYNOMIAL}

    def written(call: Any) -> Any:
        call(x, out)
        return out

    calls = {"numpy, float64": lambda: np.exp2(x64), "numpy, float32": lambda: np.exp2(x, out=out)}
    calls |= {title: partial(written, exp2_kernel(p)) for title, p in settings.items()}

    def errors(found: Any, exact: Any) -> dict[str, float]:
        return {"relative": float(np.abs(found / exact - 1).max())}

    found = compared(f"{count} numbers from -8 to 0", calls, errors, request.pick(2, 15, 31), chosen)

    def per_number(p: Point) -> Point:
        times = {name.replace("ms", "ns"): 1e6 * (p.values[name] or 0.0) / count for name in ("ms", "median_ms")}
        return replace(p, values={**times, "relative": p.values["relative"]})

    yield replace(found, points=tuple(map(per_number, found.points)))
