"""How the cost of rendering grows: pixels, Gaussians, views, threads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch

from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.splat.kernels.threads import get_threads, set_threads
from spike4dgs.method.splat.ssim import ssim
from spike4dgs.method.torch_state import one_torch_thread
from spike4dgs.studies.speed.growth import growth, thread_counts, timed
from spike4dgs.studies.speed.splat import differentiate, random_scene
from spike4dgs.studies.speed_error.measurement import Column, Request, Series

SIZES = ((200, 125), (283, 177), (400, 250), (566, 354), (800, 500), (1000, 1000))  # width, height
Call = Callable[[], Any]


def _image(splats: Splats, views: Views) -> Any:
    with torch.no_grad():
        return render(splats, views, backend="cpu").image


def _step(splats: Splats, views: Views) -> Any:
    leaves = [t.requires_grad_() for t in (*splats.geometry, splats.colors)]
    image = render(Splats(*leaves), views, backend="cpu").image
    return torch.autograd.grad(image.sum(), leaves)


def _timed(calls: dict[float, Call], name: str, column: str, request: Request) -> Series:
    with one_torch_thread():
        return timed(calls, name, column, request.pick(1, 5, 9))


def _pixels(request: Request) -> Iterator[Series]:
    n, sizes = request.pick((100, ((24, 16), (48, 32))), (20_000, SIZES), (20_000, SIZES))
    scenes = {float(w * h): random_scene(n, request.seed, w, h) for w, h in sizes}
    yield _timed({k: partial(_image, *s) for k, s in scenes.items()}, f"render {n} Gaussians", "pixels", request)
    yield _timed({k: partial(_step, *s) for k, s in scenes.items()}, "render and differentiate", "pixels", request)
    images = {float(w * h): torch.rand(2, 1, h, w) for w, h in sizes}
    calls: dict[float, Call] = {k: partial(differentiate, ssim, *pair) for k, pair in images.items()}
    yield _timed(calls, "SSIM and its gradient", "pixels", request)


def _gaussians(request: Request) -> Iterator[Series]:
    counts = request.pick(
        (10, 100), (1000, 10_000, 100_000, 1_000_000), (1000, 3000, 10_000, 30_000, 100_000, 1_000_000)
    )
    size = request.pick((24, 16), (200, 125), (400, 250))
    scenes = {}
    for n in counts:
        splats, views = random_scene(n, request.seed, *size)
        shrink = (max(counts[0], 5000) / max(n, 5000)) ** 0.5  # more Gaussians are smaller: they cover the same image
        scenes[float(n)] = Splats(splats.means, splats.quats, shrink * splats.scales, *_rest(splats)), views
    for name, call in (("render", _image), ("render and differentiate", _step)):
        yield _timed(
            {n: partial(call, *s) for n, s in scenes.items()}, f"{name}, {size[0]}x{size[1]}", "count", request
        )


def _rest(splats: Splats) -> tuple[Any, Any]:
    return splats.opacities, splats.colors


def _views(request: Request) -> Iterator[Series]:
    counts = request.pick((1, 2), (3, 8, 15, 25), (3, 5, 8, 15, 25))
    splats, one = random_scene(
        request.pick(50, 20_000, 20_000), request.seed, *request.pick((24, 16), (200, 125), (400, 250))
    )
    views = {float(n): Views(one.w2c.expand(n, 4, 4), one.K.expand(n, 3, 3), one.width, one.height) for n in counts}
    for name, call in (("render", _image), ("render and differentiate", _step)):
        yield _timed({n: partial(call, splats, v) for n, v in views.items()}, name, "views", request)


def _threads(request: Request) -> Iterator[Series]:
    splats, views = random_scene(
        request.pick(50, 50_000, 50_000), request.seed, *request.pick((24, 16), (400, 250), (800, 500))
    )
    before = get_threads()

    def with_threads(count: int, call: Callable[..., Any]) -> Any:
        set_threads(count)
        return call(splats, views)

    try:
        for name, call in (("render", _image), ("render and differentiate", _step)):
            yield _timed({float(n): partial(with_threads, n, call) for n in thread_counts()}, name, "threads", request)
    finally:
        set_threads(before)


SCALE = (
    growth("scale-pixels", "Pixels", "125x200 to 1000x1000; the Gaussians grow with the image.",
           Column("pixels", "pixels"), _pixels, (2, 25, 60)),
    growth("scale-gaussians", "Gaussians", "More Gaussians are smaller, so that they cover the same image.",
           Column("count", "Gaussians"), _gaussians, (1, 40, 90)),
    growth("scale-views", "Views", "All views are rendered in one call, whose threads share them out.",
           Column("views", "views", log=False), _views, (1, 20, 60)),
    growth("scale-threads", "Threads", "1 to 16, as many as the machine has cores.",
           Column("threads", "threads"), _threads, (1, 15, 60)),
)  # fmt: skip
