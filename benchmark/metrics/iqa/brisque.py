"""BRISQUE: the unnaturalness of an image, by a regression on the statistics of its brightness.

36 numbers (18 at each of two scales) go into the support vector machine that the authors trained on the LIVE database.
About 0 is a good image and 100 a bad one; the regression is not bounded, so that scores below 0 and above 100 occur
and are kept. It was trained on photographs: compare images of one scene with it, not scenes.

Source: Mittal, Moorthy, Bovik, "No-Reference Image Quality Assessment in the Spatial Domain", IEEE TIP 2012, and the
release of 2011. MATLAB's Image Processing Toolbox has a `brisque` with another model and other scores.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from spike4dgs.benchmark.arrays import Float64, UInt8
from spike4dgs.benchmark.metrics.iqa.natural_scene_statistics import (
    VALUE,
    WINDOW,
    check_image,
    degenerate,
    fit_asymmetric,
    fit_symmetric,
    halve,
    load_parameters,
    neighbour_sums,
    normalise,
)

_LEAST = 2 * WINDOW  # pixels a side: at half the size, one window


@dataclass(frozen=True, eq=False)
class _Regression:
    """The trained machine: features are scaled from [low, high] to [-1, 1], then compared with the vectors."""

    low: Float64  # [36]
    high: Float64  # [36]
    vectors: Float64  # [774, 36]
    weights: Float64  # [774]
    offset: float
    gamma: float  # of the kernel exp(-gamma |x - vector|^2)


def brisque(image: UInt8, where: str = "the image") -> float:
    """Return BRISQUE of a gray sRGB-encoded image [H, W]: lower is better, 0 to 100 as a rule.

    Raises UserError, with `where` as the image's name, for arrays that are no such image, are smaller than 14x14, or
    have too little texture.
    """
    check_image(image, (_LEAST, _LEAST), where)
    features = brisque_features(image)
    if not np.isfinite(features).all():
        raise degenerate(where, "hardly any")
    return score(features)


def brisque_features(image: UInt8) -> Float64:
    """Return the 36 features of a gray image [H, W]; NaN where there is nothing to fit.

    Each scale gives shape and variance of the MSCN values, and for the products with the neighbour to the right, below,
    below right and below left: shape, mean, variance of the left side, variance of the right side.
    """
    import cv2

    full = image.astype(np.float64)
    features = []
    for level in (full, halve(full)):
        mscn = normalise(level, cv2.BORDER_CONSTANT)  # black outside, as the release's filter has it
        (sums,) = neighbour_sums(mscn[None])
        products = fit_asymmetric(sums[VALUE + 1 :], mscn.size)
        values = np.stack([products.shape, products.mean, products.left**2, products.right**2], axis=-1)  # [4, 4]
        features += [np.array(fit_symmetric(sums[VALUE], mscn.size)), values.ravel()]
    return np.concatenate(features)


def score(features: Float64) -> float:
    """Return the regression's score of features [36]: sum_i weight_i exp(-gamma |x - vector_i|^2) - offset."""
    r = _regression()
    x = 2 * (features - r.low) / (r.high - r.low) - 1
    likeness = np.exp(-r.gamma * np.square(x - r.vectors).sum(axis=1))  # [774]
    return float(r.weights @ likeness) - r.offset


@cache
def _regression() -> _Regression:
    values = load_parameters("brisque")
    low, high = values["range"]
    return _Regression(low, high, values["sv"], values["coef"], float(values["rho"]), float(values["gamma"]))
