"""The rasteriser against its float64 twin: precision and gradients; and beside another program."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from functools import partial

import torch
from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.splat import PixelFilter, Splats, Views, render
from spike4dgs.method.splat.reference import Projection, alphas, composite, project, project_view
from spike4dgs.method.splat.types import ALPHA_MAX, ALPHA_MIN, CUSTOMARY, T_MIN
from spike4dgs.method.torch_state import one_torch_thread
from spike4dgs.studies.kit.measurement import TIMES, Column, Point, Request, Series, compared, max_rms, measurement
from spike4dgs.studies.kit.timing import by_turns_ms
from spike4dgs.studies.speed_error.gaussians import MEAN_RADIUS_PX, Scene, far_away, random_scene, wide

GROUP = "Rasterizer"
PATCH = 48  # px, a side of the parts that the reference composites: its memory grows with them
MAX = Column("max", "largest error, radiance")
RMS = Column("rms", "RMS error, radiance")
SURE = Column("sure", "largest error away from the cut, radiance")
PARAMETERS = ("means", "quats", "scales", "opacities", "colors")
_CLEAR = 1e-3  # relative distance from a decision, alpha >= 1/255 or T > 1e-4, that float32 takes as float64 does


def composite_patch(
    view: Projection, colors: Tensor, corner: tuple[int, int], size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Return image [h, w, F] and alpha [h, w] of the part of a view that has `size` (width, height) px from `corner`.

    Gaussians that cannot reach the part are left out, so that memory grows with the part and not with the image.
    `colors` are those of all N Gaussians.
    """
    offset = torch.tensor(corner, dtype=torch.float64)
    half = torch.tensor(size, dtype=torch.float64) / 2
    near = ((view.center - offset - half).abs() <= half + view.radius[:, None]).all(-1)
    part = Projection(*(getattr(view, f.name)[near] for f in fields(view)))
    return composite(part, part.center - offset, colors[part.index], size)


@torch.no_grad()
def cutoff_margin(splats: Splats, views: Views, pixel_filter: PixelFilter = CUSTOMARY) -> Tensor:
    """Return each pixel's distance from a decision that float32 may take otherwise, [C, H, W] float64.

    The smallest relative distance, over the Gaussians that reach the pixel, of alpha from 1/255 and of the next T
    from 1e-4. Where it is below the precision of a back end, a whole Gaussian may be there or not.
    """
    size = (views.width, views.height)
    wide = Splats(*(t.double() for t in splats.tensors))
    out = torch.full((len(views), views.height, views.width), torch.inf, dtype=torch.float64)
    for c in range(len(views)):
        s = project_view(wide, views, c, pixel_filter)
        if not len(s.index):
            continue
        raw, live = alphas(s, s.center, size)
        after = torch.cumprod(torch.where(raw >= ALPHA_MIN, 1 - raw.clamp(max=ALPHA_MAX), 1.0), 0)
        reached = torch.cat([torch.ones_like(live[:1]), after[:-1] > T_MIN / 2])
        gaps = torch.minimum((raw / ALPHA_MIN - 1).abs(), (after / T_MIN - 1).abs())
        out[c] = torch.where(reached, gaps, torch.inf).amin(0).reshape(views.height, views.width)
    return out


@torch.no_grad()
def exact_image(splats: Splats, views: Views) -> Tensor:
    """Return the image [H, W, F] of one view by the reference, float64, part by part."""
    s = wide(splats)
    view = project(s, views.w2c[0].double(), views.K[0].double(), (views.width, views.height), CUSTOMARY)
    image = torch.empty(views.height, views.width, splats.colors.shape[1], dtype=torch.float64)
    for y in range(0, views.height, PATCH):
        for x in range(0, views.width, PATCH):
            size = min(PATCH, views.width - x), min(PATCH, views.height - y)
            image[y : y + size[1], x : x + size[0]] = composite_patch(view, s.colors, (x, y), size)[0]
    return image


@measurement("splat", GROUP, "Rasterizer: float32 kernels", (*TIMES, MAX, RMS, SURE), ("rms", "max"))
def precision(request: Request) -> Iterator[Series]:
    """Gaussians are projected in float64, sorted in tiles and composited in float32, with vector code.

    Every pixel against every Gaussian in float64 (`method/splat/reference.py`), in parts of the image.

    An image is 8 to 10 bits of light. Float32 errs by less than a millionth where no decision is near; at a pixel where
    alpha is within rounding of 1/255, a whole Gaussian of 1/255 may be there or not. Parameters in float64 matter only
    far from the origin, where a model keeps them in float64. `report hard-cases` has needles, discs and huge ones.

    tests/method/splat/test_cpu.py
    """
    counts, size = request.pick(((100,), (40, 24)), ((1000, 5000), (200, 125)), ((1000, 5000, 20_000), (400, 250)))
    for n in counts:
        yield _precision(f"{n} random Gaussians", random_scene(n, request.seed, *size), request)
    yield _precision("10 km from the origin", far_away(request.seed), request)


def _precision(name: str, scene: Scene, request: Request) -> Series:
    splats, views = scene
    narrow = Splats(*(t.float() for t in splats.tensors))
    sure = cutoff_margin(splats, views)[0] > _CLEAR if views.width * len(splats) <= 200_000 else None

    def errors(found: Tensor, exact: Tensor) -> dict[str, float]:
        some = {} if sure is None or not sure.any() else {"sure": float((found - exact)[sure].abs().max())}
        return {**max_rms(found, exact), **some}

    def kernels(s: Splats) -> Tensor:
        return render(s, views, backend="cpu").image[0]

    calls = {
        "float64, all pixels": partial(exact_image, splats, views),
        "kernels, parameters in float64": partial(kernels, wide(splats)),
        "kernels, parameters in float32": partial(kernels, narrow),
    }
    with torch.no_grad(), one_torch_thread():
        return compared(name, calls, errors, request.pick(2, 9, 21), "kernels, parameters in float32", once=True)


def gradients_of(splats: Splats, views: Views, weight: Tensor, backend: str, dtype: torch.dtype) -> list[Tensor]:
    """Return the gradients of a weighted sum of the image, by `PARAMETERS`."""
    leaves = [t.to(dtype).requires_grad_() for t in splats.tensors]
    image = render(Splats(*leaves), views, backend=backend).image[0]  # type: ignore[arg-type]
    return list(torch.autograd.grad((image * weight.to(image)).sum(), leaves))


@measurement(
    "splat-gradients",
    GROUP,
    "Rasterizer: gradients",
    (*TIMES, *(Column(name, f"{name}, relative L2 error") for name in PARAMETERS)),
    ("means", "scales"),
)
def gradients(request: Request) -> Iterator[Series]:
    """The kernels replay each tile and chain its records to the parameters, in float32.

    Autograd through the float64 reference.

    Adam divides gradients by their size and its batches are four images: noise of a thousandth is far below the spread
    between batches.

    tests/method/splat/test_cpu.py
    """
    n, size = request.pick((60, (24, 16)), (300, (64, 40)), (1000, (100, 63)))
    splats, views = random_scene(n, request.seed, *size)
    weight = torch.randn(size[1], size[0], 1, generator=torch.Generator().manual_seed(request.seed + 1))
    calls = {
        "float64 by autograd": partial(gradients_of, splats, views, weight, "reference", torch.float64),
        "kernels": partial(gradients_of, splats, views, weight, "cpu", torch.float32),
    }

    def errors(found: list[Tensor], exact: list[Tensor]) -> dict[str, float]:
        return {k: float((a - b).norm() / b.norm()) for k, a, b in zip(PARAMETERS, found, exact, strict=True)}

    with one_torch_thread():
        name = f"{n} random Gaussians, {size[0]}x{size[1]}"
        yield compared(name, calls, errors, request.pick(1, 3, 9), "kernels")


@measurement(
    "splat-torch",
    GROUP,
    "Rasterizer: beside metal-gauss",
    (
        Column("count", "Gaussians"),
        *TIMES,
        Column("image", "image differs by"),
        Column("gradient", "gradients differ by, relative L2"),
    ),
    ("ms",),
    least=None,
)
def beside_torch(request: Request) -> Iterator[Series]:
    """Images of 400x250 by `torch_ref` of the package metal-gauss, which renders three channels, and by the kernels
    with one, as spike cameras need, and with three. It cuts Gaussians off at three standard deviations, where the
    kernels go on to an alpha of 1/255: images differ by up to 1/255 a Gaussian.
    """
    try:
        from metal_gauss import torch_ref
    except ImportError:
        fix = "pip install metal-gauss"
        raise problem("splat-torch", "the package metal-gauss to compare with", "none", fix) from None

    def run(program: str, scene: Scene, channels: int, backward: bool) -> tuple[Tensor, list[Tensor]]:
        (splats, v), colors = scene, scene[0].colors.expand(-1, channels)
        leaves = [t.detach().clone().requires_grad_(backward) for t in (*splats.geometry, colors)]
        if program == "metal-gauss":
            *geometry, shown = leaves
            size = (v.width, v.height)
            image = torch_ref.render(*geometry, None, v.K[0], v.w2c[0], *size, colors=shown)[0][..., :1]
        else:
            image = render(Splats(*leaves), v, backend="cpu").image[0]
        weight = torch.randn(v.height, v.width, 1, generator=torch.Generator().manual_seed(1))
        return image[..., 0].detach(), list(torch.autograd.grad((image * weight).sum(), leaves)) if backward else []

    size, counts = request.pick((40, 25), (400, 250), (400, 250)), request.pick((50,), (5000,), tuple(MEAN_RADIUS_PX))
    scenes = {n: random_scene(n, 0, *size) for n in counts}
    for backward in (False, True):
        theirs = {n: run("metal-gauss", scene, 3, backward) for n, scene in scenes.items()}
        for program, channels in (("metal-gauss", 3), ("spike4dgs", 1), ("spike4dgs", 3)):
            points = []
            for n, scene in scenes.items():
                call = partial(run, program, scene, channels, backward)
                best, median = by_turns_ms([call], 3 if program == "metal-gauss" else request.pick(1, 9, 30))[0]
                image, found = call()
                values = {"count": n, "ms": best, "median_ms": median}
                values["image"] = float((image - theirs[n][0]).abs().max())
                if backward and channels == 1:  # of three channels ours weighs all
                    both = zip(found, theirs[n][1], strict=True)
                    pairs = ((a, b[..., : a.shape[-1]] if a.ndim == 2 else b) for a, b in both)
                    values["gradient"] = max(float((a - b).norm() / b.norm()) for a, b in pairs)
                points.append(Point(str(n), values))
            what = "with gradients" if backward else "images"
            yield Series(f"{program}, {what}, {channels} channel{'s' * (channels > 1)}", tuple(points))
