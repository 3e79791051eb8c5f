"""FLIP of gray images (Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", 2020, LDR version).

The mean over pixels of the error that is visible when two images alternate on a screen, in 0..1. Both images are
filtered by the eye's contrast sensitivity; the difference of their lightness is compressed (exponent 0.7); where edges
or points appear or vanish it counts more. The screen is assumed 0.7 m wide with 3840 pixels, viewed from 0.7 m: 67.02
pixels per degree, the authors' default.

Gray images have no chroma, so of the three opponent channels only the achromatic one is computed, with separable
filters; the colour difference is that of lightness alone. The result is that of the authors' package `flip-evaluator`
for the image repeated to three channels, up to its float32.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from spike4dgs.benchmark.arrays import Float64, UInt8
from spike4dgs.benchmark.errors import problem

PIXELS_PER_DEGREE = 0.7 * (3840 / 0.7) * (math.pi / 180)
_SENSITIVITY = 0.0047  # degrees^2; b1 of the achromatic contrast sensitivity (its second Gaussian has weight 0)
_WIDEST = 0.04  # degrees^2; the largest b, of the blue-yellow channel: it sets the radius of all three filters
_FEATURE = 0.082  # degrees; width of the edge and point detectors
_COLOUR_POWER, _FEATURE_POWER = 0.7, 0.5
_KNEE, _KNEE_VALUE = 0.4, 0.95  # this share of the largest error is shown as this value
_LARGEST = 203.301655  # HyAB distance of green and blue with Hunt's adjustment: the largest in sRGB


def flip(truth: UInt8, prediction: UInt8) -> float:
    """Return FLIP of two sRGB-encoded 8-bit gray images [H, W]: 0 for equal ones, at most 1.

    Raises UserError unless both are such images of one size.

    >>> flip(np.zeros((20, 20), np.uint8), np.zeros((20, 20), np.uint8))
    0.0
    """
    for image in (truth, prediction):
        if image.dtype != np.uint8 or image.ndim != 2 or image.shape != truth.shape or image.size == 0:
            found = f"{truth.dtype} {truth.shape}, {prediction.dtype} {prediction.shape}"
            raise problem("FLIP", "two 8-bit gray images of one size", found, "encode both as sRGB first")
    a, b = (_LINEAR[image] for image in (truth, prediction))
    colour = _compressed(np.abs(_lightness(_filtered_by_eye(a)) - _lightness(_filtered_by_eye(b))))
    # The detectors take the opponent channel, 116 Y - 16, scaled back to 0..1: linear light itself.
    feature = np.maximum(*(np.abs(_strength(a, order) - _strength(b, order)) for order in (1, 2)))
    exponent = 1 - (feature / math.sqrt(2)) ** _FEATURE_POWER
    return float(np.mean(colour**exponent))


_LEVEL = np.arange(256) / 255  # of sRGB, and its linear light
_LINEAR = np.where(_LEVEL <= 0.04045, _LEVEL / 12.92, ((_LEVEL + 0.055) / 1.055) ** 2.4)


def _filtered(image: Float64, rows: Float64, columns: Float64) -> Float64:
    """Return the correlation with the outer product of two kernels; the border's pixels are repeated beyond it."""
    import cv2

    return np.asarray(cv2.sepFilter2D(image, cv2.CV_64F, columns, rows, borderType=cv2.BORDER_REPLICATE))


@cache
def _kernel(order: int) -> Float64:
    """Return the Gaussian of the feature detectors (order 0), or its first or second derivative.

    The derivatives' positive weights sum to 1 and their negative ones to -1.
    """
    sigma = 0.5 * _FEATURE * PIXELS_PER_DEGREE
    x = np.arange(-math.ceil(3 * sigma), math.ceil(3 * sigma) + 1)
    gauss = np.exp(-(x**2) / (2 * sigma**2))
    weights = gauss * (np.ones(len(x)), -x, x**2 / sigma**2 - 1)[order]
    positive, negative = weights[weights > 0].sum(), -weights[weights < 0].sum()
    return np.asarray(np.where(weights > 0, weights / positive, weights / (negative or 1)))


@cache
def _sensitivity() -> Float64:
    radius = math.ceil(3 * math.sqrt(_WIDEST / (2 * math.pi**2)) * PIXELS_PER_DEGREE)
    degrees = np.arange(-radius, radius + 1) / PIXELS_PER_DEGREE
    weights = np.exp(-((math.pi * degrees) ** 2) / _SENSITIVITY)
    return np.asarray(weights / weights.sum())


def _filtered_by_eye(image: Float64) -> Float64:
    return np.clip(_filtered(image, _sensitivity(), _sensitivity()), 0, 1)


def _lightness(light: Float64) -> Float64:
    """Return CIE L* in 0..100 of linear light."""
    cube = (6 / 29) ** 3
    root = np.where(light > cube, np.cbrt(light), light / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.asarray(116 * root - 16)


def _compressed(difference: Float64) -> Float64:
    """Return lightness differences as errors in 0..1: a power, then two straight pieces."""
    powered = difference**_COLOUR_POWER
    largest = _LARGEST**_COLOUR_POWER
    knee = _KNEE * largest
    beyond = _KNEE_VALUE + (powered - knee) / (largest - knee) * (1 - _KNEE_VALUE)
    return np.asarray(np.where(powered < knee, powered * (_KNEE_VALUE / knee), beyond))


def _strength(image: Float64, order: int) -> Float64:
    """Return the strength of the edges (order 1) or points (order 2) of an image."""
    gauss, derivative = _kernel(0), _kernel(order)
    across, down = _filtered(image, gauss, derivative), _filtered(image, derivative, gauss)
    return np.asarray(np.sqrt(across * across + down * down))
