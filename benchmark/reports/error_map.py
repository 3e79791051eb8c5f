"""The error map: absolute error of linear radiance in one colour map, on a scale that is shown with it.

A scale is one of `SCALES`, so that maps of methods of about the same quality can be compared. The viewer
always uses the widest.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from spike4dgs.benchmark.arrays import Float32, UInt8

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = "magma"  # a colour map of matplotlib: black to nearly white, even steps, legible to the colour-blind
ERROR_MAX = 0.3  # the brightest colour: larger errors look the same
SCALES = (ERROR_MAX, 0.1, 0.03, 0.01)  # half a decade each: "error x1, x3, x10, x30"
OFF_SCALE = 0.02  # share of the pixels that may be beyond a scale


def absolute_error(image: Float32, truth: Float32) -> Float32:
    """Return |image - truth| [H, W] of linear radiance, both clipped to [0, 1]."""
    return np.asarray(np.abs(np.clip(image, 0, 1) - np.clip(truth, 0, 1)))


def choose_scale(errors: Iterable[Float32]) -> float:
    """Return the smallest of `SCALES` that at most `OFF_SCALE` of the pixels of some error maps exceed."""
    maps = [np.ravel(error) for error in errors]
    largest = float(np.quantile(np.concatenate(maps), 1 - OFF_SCALE)) if maps else ERROR_MAX
    return min((scale for scale in SCALES if scale >= largest), default=ERROR_MAX)


def scale_name(scale: float) -> str:
    """Return how a scale is told, such as "error x3"."""
    return f"error \N{MULTIPLICATION SIGN}{ERROR_MAX / scale:.0f}"


def error_image(image: Float32, truth: Float32, scale: float = ERROR_MAX) -> UInt8:
    """Return the error map as RGB [H, W, 3]; `scale` is the error of the brightest colour."""
    error = absolute_error(image, truth).clip(max=scale)
    return error_colors()[np.rint(error * (255 / scale)).astype(np.uint8)]


def error_levels(image: Float32, truth: Float32) -> UInt8:
    """Return the error map as gray levels [H, W] for programs that choose scale and colours: 255 sqrt(e / ERROR_MAX).

    The root gives small errors many levels: a level is less than 0.0003 for errors below 0.01.
    """
    share = absolute_error(image, truth).clip(max=ERROR_MAX) / ERROR_MAX
    return np.asarray(np.rint(255 * np.sqrt(share)), np.uint8)


@cache
def error_colors() -> UInt8:
    """Return the colours [256, 3] of errors from 0 to the scale's end."""
    from matplotlib import colormaps

    return np.asarray((colormaps[COLORS](np.arange(256))[:, :3] * 255).round().astype(np.uint8))


def show_error(axes: Axes, image: Float32, truth: Float32) -> None:
    """Show the error map of an image on matplotlib axes."""
    axes.imshow(absolute_error(image, truth), cmap=COLORS, vmin=0, vmax=ERROR_MAX, interpolation="nearest")


def show_error_scale(axes: Axes) -> None:
    """Show the scale of the error maps, a legend, in the middle of matplotlib axes that are otherwise empty."""
    axes.axis("off")
    scale = axes.inset_axes((0.08, 0.45, 0.84, 0.14))
    scale.imshow(np.linspace(0, 1, 256)[None], cmap=COLORS, aspect="auto", extent=(0, ERROR_MAX, 0, 1))
    scale.set_yticks([])
    scale.tick_params(labelsize=7)
    scale.set_xlabel("absolute error (1 = white)", fontsize=8)
