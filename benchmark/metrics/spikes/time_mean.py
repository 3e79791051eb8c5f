"""Means of an image over time, from images at a few ticks: linear between them, constant before the first and after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


def time_mean(
    ticks: Sequence[int], images: Sequence[Float64], start: float | Float64, stop: float | Float64
) -> Float64:
    """Return the mean [H, W] of images at ascending ticks over the time from `start` to `stop`, in ticks.

    `start` and `stop` are numbers, or one for each pixel [H, W]. An image belongs to the instant at which its tick
    begins.

    >>> time_mean([0, 10], [np.zeros((1, 1)), np.ones((1, 1))], 5.0, 15.0)
    array([[0.875]])
    """
    mean = images[0].copy()
    for (a, before), (b, image) in zip(
        zip(ticks[:-1], images[:-1], strict=True), zip(ticks[1:], images[1:], strict=True), strict=True
    ):
        share = (_ramp_area(stop, a, b) - _ramp_area(start, a, b)) / (np.asarray(stop) - start)
        if np.any(share):
            mean += share * (image - before)
    return mean


def _ramp_area(x: float | Float64, a: int, b: int) -> Float64:
    """Return the area up to x under a function that is 0 before a, rises to 1 at b, and stays there."""
    risen = np.clip(np.asarray(x, np.float64) - a, 0, b - a)
    return np.asarray(risen**2 / (2 * (b - a)) + np.maximum(np.asarray(x, np.float64) - b, 0))
