"""Predictions beside the truth and its noise: honest predictions neither equal the truth nor carry its noise.

The truth is a Monte Carlo rendering T = S + n. Two second renderings A and B of one target have noise of their own, so
that the mean of (T - A)(T - B) estimates the variance of n without bias. It gives

    the ceiling      the PSNR of the truth against S, which no method exceeds that has not seen T
    the noise share  mean of (P - A)(T - B) over mean of (T - A)(T - B), of high-passed images: the regression of the
                     prediction P on n, which is 1 for P = T, whatever other noise is added, and 0 for any P that is
                     independent of n

Neither tells a denoised truth from a good method: fitting again does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.runs.predictions import Predictions
from spike4dgs.benchmark.scene.scene import Scene, Target

Renderings = tuple[Target, Float32, Float32]
SecondRenderings = Callable[[Scene], Renderings | None]
MAX_EQUAL_PIXELS = 0.25  # half floats of good renderings equal the truth's in a few percent of the pixels
MAX_NOISE_SHARE = 0.1  # 0 for honest predictions; a tenth of the truth mixed in gives as much
STANDARD_ERRORS = 5.0  # beyond chance: the noise has heavy tails, and honest fits of van reach three
COPY, NOISE = "equals truth", "carries the truth's noise"
_WINDOW = 3  # px of the high-pass: texture that predictions blur is left out, Monte Carlo noise is white


@dataclass(frozen=True)
class TruthCheck:
    """The predictions of a scene beside its truth; without second renderings the last four are None."""

    images: int
    equal_images: int  # with more than `MAX_EQUAL_PIXELS` equal ones
    equal_pixels: float  # share of all images; without black and white pixels, which may well agree
    noise_share: float | None = None
    noise_share_error: float | None = None  # standard error
    ceiling_db: float | None = None
    target: str | None = None  # that was rendered again


def no_renderings(scene: Scene) -> None:
    """Return no second renderings: their checks are left out."""


def check_truth(predictions: Predictions, scene: Scene, second_renderings: SecondRenderings) -> TruthCheck:
    """Compare predictions with the truth; with second renderings of a target, also with its noise."""
    equal_images = equal = compared = 0
    for target in scene.targets:
        truth, image = scene.ground_truth(target), predictions.read(target)
        gray = (truth > 0) & (truth < 1)
        same, of = int(((truth == image) & gray).sum()), int(gray.sum())
        equal, compared = equal + same, compared + of
        equal_images += same > MAX_EQUAL_PIXELS * of
    found = TruthCheck(len(scene.targets), equal_images, equal / max(compared, 1))
    if (renderings := second_renderings(scene)) is None:
        return found
    target, first, second = renderings
    truth, image = scene.ground_truth(target), predictions.read(target)
    share, error = noise_share(image, truth, first, second)
    noise = noise_ceiling_db(truth, first, second)
    return TruthCheck(found.images, equal_images, found.equal_pixels, share, error, noise, target.name)


def truth_flags(check: Mapping[str, Any]) -> Iterator[str]:
    """Yield the flags that follow from what an entry states of a scene's `TruthCheck`."""
    if check["equal_images"] or check["equal_pixels"] > MAX_EQUAL_PIXELS:
        yield COPY
    share, error = check["noise_share"], check["noise_share_error"]
    if share is not None and share - STANDARD_ERRORS * error > MAX_NOISE_SHARE:
        yield NOISE


def noise_ceiling_db(truth: NDArray[Any], first: NDArray[Any], second: NDArray[Any]) -> float | None:
    """Return the PSNR of the truth [H, W] against what it would be without noise; None where no noise is seen."""
    t, a, b = (_clipped(image) for image in (truth, first, second))
    variance = float(np.mean((t - a) * (t - b)))
    return -10 * math.log10(variance) if variance > 0 else None


def noise_share(
    image: NDArray[Any], truth: NDArray[Any], first: NDArray[Any], second: NDArray[Any]
) -> tuple[float | None, float | None]:
    """Return the share of the truth's noise that an image [H, W] carries, and its standard error.

    The image is first scaled to the second renderings, since a copy may be darker. None where no noise is seen.
    """
    p, t, a, b = (_clipped(i) for i in (image, truth, first, second))
    square = float(np.sum(p * p))
    p = p * (float(np.sum(p * (a + b) / 2)) / square) if square > 0 else p
    noise = _high_pass(t - a), _high_pass(t - b)
    carried = (_high_pass(p - a) * noise[1] + _high_pass(p - b) * noise[0]) / 2
    variance = noise[0] * noise[1]
    if (mean := float(variance.mean())) <= 0:
        return None, None
    share = float(carried.mean()) / mean
    spread = float(np.std(carried - share * variance))
    return share, spread / math.sqrt(variance.size) / mean


def _clipped(image: NDArray[Any]) -> Float64:
    return np.clip(image.astype(np.float64), 0, 1)


def _high_pass(image: Float64) -> Float64:
    """Return an image [H, W] less the mean of each pixel's window."""
    from scipy.ndimage import uniform_filter

    return np.asarray(image - uniform_filter(image, _WINDOW))


def once_a_scene(second_renderings: SecondRenderings) -> SecondRenderings:
    """Return the same renderings; those of a scene are rendered once for all entries."""
    known: dict[tuple[str, str, str], Renderings | None] = {}

    def render(scene: Scene) -> Renderings | None:
        key = scene.id, scene.revision, scene.split
        if key not in known:
            known[key] = second_renderings(scene)
        return known[key]

    return render
