"""Detection of what changes in a clip: the variation of every pixel over time, and the limits of all who use it.

A fixed camera sees a static scene as one image with noise. The variation of a pixel over the clip therefore separates
moving objects from static ones without any learned segmentation. Spikes make noise of their own, so each user has a
limit for its kind of images. The settings differ in blur and precision too; making them equal would change results.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True)
class ChangeSettings:
    """Numbers of the detector for one kind of images."""

    limit: float  # a pixel changes where its variation is larger; in the unit of the images
    statistic: Literal["deviation", "range"] = "deviation"  # standard deviation over time, or largest minus smallest
    blur_px: int = 1  # images are averaged over this width first: spike noise is white, objects are not
    zeros_outside: bool = False  # at the border the average includes zeros outside the image
    float64: bool = False  # sums in float64, one time after another: a float64 copy of the clip would not fit
    lowest: float | None = None  # the limit follows the noise, from this up to `limit`; None: it is always `limit`
    noise_share: float = 0.25  # at least this share of the pixels shows nothing but noise
    noise_factor: float = 4.0  # noise differs by a factor of two between dark and bright; motion exceeds it by ten


# Points of Gaussians, which become background or get several copies over time: the median of the views' images at
# them, white = 1. Recipes override the limit.
POINTS = ChangeSettings(limit=0.03, blur_px=5)

# Masks of the foreground, for tracking: images with white = 1. The limit has bounds because images may be clean, or
# everything may move.
MASKS = ChangeSettings(limit=0.05, lowest=0.01, blur_px=3, zeros_outside=True, float64=True)

# Rays of the radiance field: spikes per tick. Windows of 40 ticks give noise of 0.0125.
RAYS = ChangeSettings(limit=0.04)

# Spike counts of the plane sweep's windows. Those of a pixel that sees constant radiance differ by 1.
COUNTS = ChangeSettings(limit=2, statistic="range")

# The same for images of other sensors, with white = 1: 2 of the 24 spikes of white in such a window.
RECORDED = ChangeSettings(limit=0.08, statistic="range")


def variation(images: Tensor, s: ChangeSettings) -> Tensor:
    """Return how much each pixel varies over time, [C, H, W], from images [T, C, H, W]."""
    if s.statistic == "range":
        return images.amax(0) - images.amin(0)
    if not s.float64:
        return _blurred(images, s).std(0, correction=0)
    total = torch.zeros(images.shape[1:], dtype=torch.float64, device=images.device)
    square = total.clone()
    for image in images:
        smooth = _blurred(image[:, None].double(), s)[:, 0]
        total += smooth
        square += smooth * smooth
    n = len(images)
    return (square / n - (total / n) ** 2).clamp(min=0).sqrt()


def changing(images: Tensor, s: ChangeSettings) -> Tensor:
    """Return the pixels that change: bool [C, H, W] from images [T, C, H, W]; none where a value is no number."""
    found = variation(images, s)
    if s.lowest is None:
        return found > s.limit
    values = found.cpu().numpy()
    noise = np.quantile(values[np.isfinite(values)], s.noise_share)
    return found > float(np.clip(s.noise_factor * noise, s.lowest, s.limit))


def without_specks(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return a mask [H, W] of 0 and 1 without single pixels, which are noise."""
    return np.asarray(cv2.medianBlur(mask.astype(np.uint8), 3))


def _blurred(images: Tensor, s: ChangeSettings) -> Tensor:
    if s.blur_px == 1:
        return images
    return functional.avg_pool2d(images, s.blur_px, 1, s.blur_px // 2, count_include_pad=s.zeros_outside)
