"""A model beside what it was fitted to: the images that the recipe makes from the spikes, at a few times of the clip.

The difference is a residual, and no score: the model has seen these images, and their noise is in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.method import Method, Model
from spike4dgs.benchmark.metrics.metric import MAX_PSNR_DB
from spike4dgs.benchmark.reports.error_map import show_error, show_error_scale
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.images.training import ImageSettings, as_measured, make_images
from spike4dgs.method.self_calibration.dark_drift import in_todays_dark

TIMES = 9  # of the clip, that residuals are taken at
SHOWN = (1, 4, 7)  # those of them that the sheet shows


@dataclass(frozen=True, eq=False)
class Comparison:
    """Images from spikes and the model's, [T, C, H, W] linear radiance; NaN where a camera has measured nothing."""

    cameras: tuple[Camera, ...]
    times_us: tuple[float, ...]
    images: Float32
    rendered: Float32
    maker: str  # of the images


def compare(
    method: Method, model: Model, scene: TrainingScene, cameras: Sequence[Camera], device: str, other: ImageMaker
) -> Comparison:
    """Return the model's images of the training cameras beside those made from their spikes.

    Those are the recipe's own; `other` makes them for a method that is no recipe, or one of other sensors.
    """
    recipe = method if isinstance(method, RecipeMethod) and not method.images.given else None
    maker = recipe.recipe.images if recipe else other.name
    make = recipe.maker(recipe.settings) if recipe else other
    settings: ImageSettings = recipe.settings["images"] if recipe else ImageSettings()  # type: ignore[assignment]
    if settings.flat_field:
        scene = in_todays_dark(scene)  # as the fit has it
    ticks, images, _ = make_images(scene, make, replace(settings, max_times=TIMES), device)
    times = tuple(tick * 1e6 / scene.rate_hz for tick in ticks)
    rendered = np.stack([[model.render(camera, t) for camera in cameras] for t in times])
    return Comparison(tuple(cameras), times, as_measured(scene, ticks, images), rendered, maker)


def residual_db(image: NDArray[np.floating], rendered: NDArray[np.floating]) -> float:
    """Return the PSNR in dB of renders against images, over all pixels that are numbers; both clipped to [0, 1].

    NaN where there is none, MAX_PSNR_DB where they are equal.

    >>> round(residual_db(np.array([0.5, np.nan]), np.array([0.6, 0.0])), 3)
    20.0
    """
    known = np.isfinite(image)
    if not known.any():
        return math.nan
    difference = np.clip(image[known], 0, 1).astype(np.float64) - np.clip(rendered[known], 0, 1)
    error = float(np.mean(difference**2))
    return min(-10 * math.log10(error), MAX_PSNR_DB) if error > 0 else MAX_PSNR_DB


def residuals(found: Comparison) -> dict[str, float]:
    """Return the residual of every camera over all times, in dB."""
    return {camera.id: residual_db(found.images[:, c], found.rendered[:, c]) for c, camera in enumerate(found.cameras)}


def mean_residual(found: Comparison) -> float:
    """Return the mean of the cameras' residuals in dB, of those that have measured something."""
    known = [value for value in residuals(found).values() if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan


def write_sheet(path: Path, found: Comparison, title: str) -> None:
    """Write a PNG: for every camera a row, and at three times the image from spikes, the model's, and the error map."""
    shown = sorted({min(i, len(found.times_us) - 1) for i in SHOWN})
    first, width = found.cameras[0], 1.75
    height = width * first.height / first.width + 0.22
    figure = new_figure((width * 3 * len(shown), height * len(found.cameras) + 1.2), "compressed")
    axes = figure.subplots(len(found.cameras) + 1, 3 * len(shown), squeeze=False)
    for c, camera in enumerate(found.cameras):
        for k, t in enumerate(shown):
            image, rendered = found.images[t, c], found.rendered[t, c]
            row = axes[c, 3 * k : 3 * k + 3]
            for ax, content in zip(row[:2], (image, rendered), strict=True):
                ax.imshow(encode_srgb(content), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
            show_error(row[2], rendered, image)
            heads = f"{found.maker} image", f"model, {found.times_us[t] / 1e3:.1f} ms", "error"
            texts = heads if c == 0 else ("", "", "")
            for ax, text in zip(row, texts, strict=True):
                ax.set(xticks=[], yticks=[])
                ax.set_title(text, fontsize=8)
        axes[c, 0].set_ylabel(camera.id, fontsize=8)
    for ax in axes[-1]:
        ax.axis("off")
    show_error_scale(axes[-1, 3 * (len(shown) // 2) + 1])
    figure.suptitle(title, fontsize=11)
    save_figure(figure, path)
