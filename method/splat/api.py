"""The one entry point: `render`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Literal

from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.splat.cpu import render_cpu
from spike4dgs.method.splat.cuda.render import render_cuda
from spike4dgs.method.splat.reference import render_reference
from spike4dgs.method.splat.types import EPS2D, NEAR, RenderOutput, Splats, Views

Backend = Literal["auto", "reference", "cpu", "cuda"]
_BACKENDS: dict[str, Callable[..., RenderOutput]] = {
    "reference": render_reference,
    "cpu": render_cpu,
    "cuda": render_cuda,
}


def render(
    splats: Splats,
    views: Views,
    *,
    background: Tensor | None = None,
    depth: bool = False,
    antialiased: bool = False,
    near: float = NEAR,
    eps2d: float = EPS2D,
    backend: Backend = "auto",
) -> RenderOutput:
    """Render N Gaussians into C views, differentiable in every tensor of `splats` and in `views.w2c`.

    Args:
        splats: the Gaussians; float64 tensors are projected in float64, which a world far from its origin needs.
        views: the cameras.
        background: [F] or [C, F], the colour behind the Gaussians; None is black.
        depth: also accumulate the camera-space z with the colours' weights.
        antialiased: dim Gaussians that the pixel filter enlarges, so that their total light stays.
        near: Gaussians whose centre is nearer than this (in world units) are not rendered.
        eps2d: variance of the pixel filter, px^2.
        backend: "reference" (float64, tiny scenes), "cpu" (numba), "cuda" (numba-cuda); "auto" chooses by
            the device.

    Raises:
        UserError: for wrong shapes, non-finite values, or a back end that is not installed.
    """
    if background is not None and background.shape not in [(n,) for n in splats.colors.shape[1:]] + [
        (len(views), splats.colors.shape[1])
    ]:
        found, n = str(tuple(background.shape)), splats.colors.shape[1]
        raise problem("background", f"[{n}] or [{len(views)}, {n}]", found, "give one value per colour channel")
    if not (near > 0 and eps2d >= 0):
        raise problem("render", "near > 0 and eps2d >= 0", f"near {near}, eps2d {eps2d}", "correct the argument")
    if backend == "auto":
        backend = "cpu" if splats.means.device.type == "cpu" else "cuda"
    if backend not in _BACKENDS:
        raise problem("backend", ", ".join(["auto", *_BACKENDS]), str(backend), "choose one of them")
    if backend != "cuda" and splats.means.device.type != "cpu":
        raise problem(f"back end {backend}", "tensors on the CPU", str(splats.means.device), "move them with .cpu()")
    out = _BACKENDS[backend](splats, views, depth=depth, antialiased=antialiased, near=near, eps2d=eps2d)
    if background is None:
        return out
    behind = background.reshape(-1, 1, 1, background.shape[-1]) * (1 - out.alpha)[..., None]
    return dataclasses.replace(out, image=out.image + behind)
