"""The rasteriser against its float64 twin: precision, gradients, and whether a background is rendered again."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.splat.background import Background, join
from spike4dgs.method.splat.reference import composite_patch, cutoff_margin, project
from spike4dgs.method.splat.types import EPS2D, NEAR
from spike4dgs.method.torch_state import one_torch_thread
from spike4dgs.studies.speed.splat import random_scene
from spike4dgs.studies.speed.timing import by_turns_ms
from spike4dgs.studies.speed_error.measurement import (
    MEDIAN_MS,
    MS,
    Column,
    Measurement,
    Point,
    Request,
    Series,
)
from spike4dgs.studies.twins.inputs import Scene, hard_scenes

GROUP = "Rasterizer"
PATCH = 48  # px, a side of the parts that the reference composites: its memory grows with them
MAX = Column("max", "largest error, radiance")
RMS = Column("rms", "RMS error, radiance")
SURE = Column("sure", "largest error away from the cut, radiance")
_CLEAR = 1e-3  # relative distance from a decision, alpha >= 1/255 or T > 1e-4, that float32 takes as float64 does


@torch.no_grad()
def exact_image(splats: Splats, views: Views) -> Tensor:
    """Return the image [H, W, F] of one view by the reference, float64, part by part."""
    wide = _wide(splats)
    view = project(wide, views.w2c[0].double(), views.K[0].double(), (views.width, views.height), False, NEAR, EPS2D)
    image = torch.empty(views.height, views.width, splats.colors.shape[1], dtype=torch.float64)
    for y in range(0, views.height, PATCH):
        for x in range(0, views.width, PATCH):
            size = min(PATCH, views.width - x), min(PATCH, views.height - y)
            image[y : y + size[1], x : x + size[0]] = composite_patch(view, wide.colors, (x, y), size)[0]
    return image


def _precision(request: Request) -> Iterator[Series]:
    counts, size = request.pick(((100,), (40, 24)), ((1000, 5000), (200, 125)), ((1000, 5000, 20_000), (400, 250)))
    for n in counts:
        yield _compared(f"{n} random Gaussians", random_scene(n, request.seed, *size), request)
    for name, scene in hard_scenes(request.seed).items():
        yield _compared(name, scene, request)


def _compared(name: str, scene: Scene, request: Request) -> Series:
    """Return the series of one scene: the reference once, the kernels by turns."""
    splats, views = scene
    narrow = Splats(*(t.float() for t in (*splats.geometry, splats.colors)))
    wide = _wide(splats)
    settings = {"parameters in float64": wide, "parameters in float32": narrow}
    with torch.no_grad(), one_torch_thread():
        start = time.perf_counter()
        exact = exact_image(splats, views)
        exact_ms = 1e3 * (time.perf_counter() - start)
        kernels = [partial(render, s, views, backend="cpu") for s in settings.values()]
        times = by_turns_ms(kernels, request.pick(2, 9, 21))
    sure = cutoff_margin(splats, views)[0] > _CLEAR if views.width * len(splats) <= 200_000 else None
    points = [Point("float64, all pixels", {"ms": exact_ms, "median_ms": exact_ms, "max": 0.0, "rms": 0.0}, "exact")]
    for (title, s), (best, median) in zip(settings.items(), times, strict=True):
        error = (render(s, views, backend="cpu").image[0].double() - exact).abs()
        values = {
            "ms": best,
            "median_ms": median,
            "max": float(error.max()),
            "rms": float(error.square().mean().sqrt()),
        }
        if sure is not None and sure.any():
            values["sure"] = float(error[sure].max())
        points.append(Point(f"kernels, {title}", values, "chosen" if s is narrow else ""))
    return Series(name, tuple(points))


def _gradients(request: Request) -> Iterator[Series]:
    n, size = request.pick((60, (24, 16)), (300, (64, 40)), (1000, (100, 63)))
    splats, views = random_scene(n, request.seed, *size)
    weight = torch.randn(size[1], size[0], 1, generator=torch.Generator().manual_seed(request.seed + 1))
    names = ("means", "quats", "scales", "opacities", "colors")

    def gradients(backend: str, dtype: torch.dtype) -> list[Tensor]:
        leaves = [t.to(dtype).requires_grad_() for t in (*splats.geometry, splats.colors)]
        image = render(Splats(*leaves), views, backend=backend).image[0]  # type: ignore[arg-type]
        return list(torch.autograd.grad((image * weight.to(image)).sum(), leaves))

    calls = [partial(gradients, "reference", torch.float64), partial(gradients, "cpu", torch.float32)]
    with one_torch_thread():
        (slow, fast), exact, found = by_turns_ms(calls, request.pick(1, 3, 9)), *(call() for call in calls)
    points = [Point("float64 by autograd", {"ms": slow[0], "median_ms": slow[1], **dict.fromkeys(names, 0.0)}, "exact")]
    errors = {k: float((a - b).norm() / b.norm()) for k, a, b in zip(names, found, exact, strict=True)}
    points.append(Point("kernels", {"ms": fast[0], "median_ms": fast[1], **errors}, "chosen"))
    yield Series(f"{n} random Gaussians, {size[0]}x{size[1]}", tuple(points))


def _background(request: Request) -> Iterator[Series]:
    n, size = request.pick((200, (40, 24)), (20_000, (200, 125)), (50_000, (400, 250)))
    splats, views = random_scene(n, request.seed, *size)
    leftmost = splats.means[:, 0].div(splats.means[:, 2]).argsort()
    tensors = (*splats.geometry, splats.colors)
    moving_first: list[Point] = []
    for share in (0.02, 0.1, 0.3, 1.0):
        cut = max(1, round(share * n))
        moving, still = (Splats(*(t[part] for t in tensors)) for part in (leftmost[:cut], leftmost[cut:]))
        background, whole = Background(still, views), join(still, moving)
        with torch.no_grad():
            calls = [partial(render, whole, views, backend="cpu"), partial(background.render, moving, [0])]
            everything, only = by_turns_ms(calls, request.pick(2, 9, 21))
            error = (calls[0]().image - calls[1]().image).abs()
        name = f"{share:.0%} move"
        values = {"share": 100 * share, "ms": only[0], "all_ms": everything[0], "max": float(error.max())}
        moving_first.append(Point(name, values, "chosen"))
    yield Series("only what moves is rendered", tuple(moving_first))
    again = [Point(p.name, {**p.values, "ms": p.values["all_ms"], "max": 0.0}, "exact") for p in moving_first]
    yield Series("all is rendered", tuple(again))


def _wide(splats: Splats) -> Splats:
    return Splats(*(t.double() for t in (*splats.geometry, splats.colors)))


PRECISION = Measurement(
    id="splat",
    group=GROUP,
    title="Rasterizer: float32 kernels",
    approximation="Gaussians are projected in float64, sorted in tiles and composited in float32, with vector code.",
    exact="Every pixel against every Gaussian in float64 (`method/splat/reference.py`), in parts of the image.",
    reason="An image is 8 to 10 bits of light. Float32 errs by less than a millionth where no decision is "
    "near; at a pixel where alpha is within rounding of 1/255, a whole Gaussian of 1/255 may be there or not. "
    "Parameters in float64 matter only far from the origin, where a model keeps them in float64.",
    columns=(MS, MEDIAN_MS, MAX, RMS, SURE),
    x="ms",
    y=("rms", "max"),
    run=_precision,
    seconds={"tiny": 8, "quick": 40, "whole": 400},
    held_by="tests/method/splat/test_cpu.py",
)
GRADIENTS = Measurement(
    id="splat-gradients",
    group=GROUP,
    title="Rasterizer: gradients",
    approximation="The kernels replay each tile and chain its records to the parameters, in float32.",
    exact="Autograd through the float64 reference.",
    reason="Adam divides gradients by their size and its batches are four images: noise of a thousandth is far below "
    "the spread between batches.",
    columns=(
        MS,
        MEDIAN_MS,
        *(Column(name, f"{name}, relative L2 error") for name in ("means", "quats", "scales", "opacities", "colors")),
    ),
    x="ms",
    y=("means", "scales"),
    run=_gradients,
    seconds={"tiny": 1, "quick": 5, "whole": 60},
    held_by="tests/method/splat/test_cpu.py",
)
BACKGROUND = Measurement(
    id="background",
    group=GROUP,
    title="Background: rendered once",
    approximation="What does not move is projected and listed once; tiles that nothing else touches are copied.",
    exact="All Gaussians rendered again.",
    reason="The images are equal to the bit, so that only time counts. The gain ends where everything moves.",
    columns=(
        Column("share", "share of Gaussians that move, %"),
        MS,
        Column("all_ms", "all rendered again, ms"),
        Column("max", "largest difference, radiance"),
    ),
    x="share",
    y=("ms",),
    cost="ms",
    error="max",
    run=_background,
    seconds={"tiny": 1, "quick": 8, "whole": 30},
    held_by="tests/method/splat/test_background.py",
)
