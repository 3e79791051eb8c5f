"""The error map: absolute error of linear radiance, in one colour map and on one scale wherever it is shown."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from spike4dgs.benchmark.scene.images import Float32, UInt8

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = "magma"  # a colour map of matplotlib: black to nearly white, even steps, legible to the colour-blind
ERROR_MAX = 0.3  # the brightest colour: larger errors look the same


def absolute_error(image: Float32, truth: Float32) -> Float32:
    """Return |image - truth| [H, W] of linear radiance, both clipped to [0, 1]."""
    return np.asarray(np.abs(np.clip(image, 0, 1) - np.clip(truth, 0, 1)))


def error_image(image: Float32, truth: Float32) -> UInt8:
    """Return the error map as RGB [H, W, 3]."""
    error = absolute_error(image, truth).clip(max=ERROR_MAX)
    return error_colors()[np.rint(error * (255 / ERROR_MAX)).astype(np.uint8)]


@cache
def error_colors() -> UInt8:
    """Return the colours [256, 3] of errors from 0 to `ERROR_MAX`."""
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
