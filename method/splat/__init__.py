"""Gaussian splatting: one `render` call over a float64 reference, CPU kernels and CUDA kernels."""

from spike4dgs.method.splat.api import render
from spike4dgs.method.splat.kernels.threads import set_threads
from spike4dgs.method.splat.types import PixelFilter, RenderOutput, Splats, Views

__all__ = ["PixelFilter", "RenderOutput", "Splats", "Views", "render", "set_threads"]
