"""The one entry point: `render`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.splat.cpu import render_cpu
from spike4dgs.method.splat.cuda.render import render_cuda
from spike4dgs.method.splat.reference import render_reference
from spike4dgs.method.splat.types import CUSTOMARY, PixelFilter, RenderOutput, Splats, Views

Backend = Literal["auto", "reference", "cpu", "cuda"]
_BACKENDS: dict[str, Callable[[Splats, Views, PixelFilter, bool], RenderOutput]] = {
    "reference": render_reference,
    "cpu": render_cpu,
    "cuda": render_cuda,
}


def render(
    splats: Splats,
    views: Views,
    pixel_filter: PixelFilter = CUSTOMARY,
    *,
    depth: bool = False,
    backend: Backend = "auto",
) -> RenderOutput:
    """Render N Gaussians into C views, differentiable in every tensor of `splats` and in `views.w2c`.

    Args:
        splats: the Gaussians; float64 tensors are projected in float64, which a world far from its origin needs.
        views: the cameras, with their lenses.
        pixel_filter: what is added to every projection.
        depth: also accumulate the camera-space z with the colours' weights.
        backend: "reference" (float64, tiny scenes), "cpu" (numba), "cuda" (numba-cuda); "auto" chooses by
            the device.

    Raises:
        UserError: for wrong shapes, non-finite values, or a back end that is not installed.
    """
    if not pixel_filter.variance >= 0:
        raise problem("render", "a filter's variance >= 0", f"{pixel_filter.variance}", "correct the argument")
    if backend == "auto":
        backend = "cpu" if splats.means.device.type == "cpu" else "cuda"
    if backend not in _BACKENDS:
        raise problem("backend", ", ".join(["auto", *_BACKENDS]), str(backend), "choose one of them")
    if backend != "cuda" and splats.means.device.type != "cpu":
        raise problem(f"back end {backend}", "tensors on the CPU", str(splats.means.device), "move them with .cpu()")
    return _BACKENDS[backend](splats, views, pixel_filter, depth)
