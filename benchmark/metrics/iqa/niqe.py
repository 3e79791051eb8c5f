"""NIQE: the distance of an image's statistics from those of undistorted photographs.

The image is cut into blocks of 96x96 pixels. The 36 features of the blocks (18 at each of two scales) have a mean and a
covariance, and so had those of the authors' pristine photographs; the score is a distance between the two Gaussians:

    D = sqrt((m - m')^T ((C + C') / 2)^-1 (m - m'))

About 3 is a natural image; larger is worse. Few blocks give an uncertain covariance: parts of one 250x400 image
scored between 3.1 and 5.2. Never compare scores of different resolutions.

Source: Mittal, Soundararajan, Bovik, "Making a 'Completely Blind' Image Quality Analyzer", IEEE SPL 2013, and the
release of 2012. MATLAB's Image Processing Toolbox has a `niqe` with another model and other scores.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from spike4dgs.benchmark.arrays import Float64, UInt8
from spike4dgs.benchmark.metrics.iqa.natural_scene_statistics import (
    VALUE,
    check_image,
    degenerate,
    fit_asymmetric,
    halve,
    load_parameters,
    neighbour_sums,
    normalise,
)

BLOCK = 96  # pixels a side; the pristine model was made with blocks of this size


def niqe(image: UInt8, where: str = "the image") -> float:
    """Return NIQE of a gray sRGB-encoded image [H, W]: lower is better.

    Pixels at the right and at the bottom beyond whole blocks are not used. Blocks without texture (all
    one gray level, for example) have no features and are left out.

    Raises UserError, with `where` as the image's name, for arrays that are no such image, or where fewer than two
    blocks are usable.
    """
    check_image(image, (BLOCK, BLOCK), where)
    features = niqe_features(image)
    usable = features[np.isfinite(features).all(axis=1)]
    if len(usable) < 2:
        expected = f"at least two blocks of {BLOCK}x{BLOCK} pixels with texture"
        raise degenerate(where, f"{len(usable)} of {len(features)}", expected)
    return distance(usable)


def niqe_features(image: UInt8) -> Float64:
    """Return 36 features of each block of a gray image [H, W]: [n, 36], row by row; NaN where there is nothing to fit.

    Each scale gives shape and mean scale of the MSCN values, and for the products with the neighbour to the right,
    below, below right and below left: shape, mean, left scale, right scale.
    """
    import cv2

    full = image[: image.shape[0] // BLOCK * BLOCK, : image.shape[1] // BLOCK * BLOCK].astype(np.float64)
    features = []
    for level, side in ((full, BLOCK), (halve(full), BLOCK // 2)):
        blocks = _cut(normalise(level, cv2.BORDER_REPLICATE), side)
        sums = neighbour_sums(blocks)  # [n, 5, 5]
        fits = fit_asymmetric(sums, blocks[0].size)  # [n, 5]
        left, right = fits.scales
        values = np.stack([fits.shape, (left + right) / 2], axis=-1)[:, VALUE]
        products = np.stack([fits.shape, fits.mean, left, right], axis=-1)[:, VALUE + 1 :]
        features += [values, products.reshape(len(blocks), -1)]
    return np.concatenate(features, axis=1)


def distance(features: Float64) -> float:
    """Return the distance of the Gaussian of features [n, 36] from the pristine one."""
    mean, covariance = _pristine()
    offset = features.mean(axis=0) - mean
    pooled = (covariance + np.cov(features, rowvar=False)) / 2  # the pristine half alone has full rank
    return float(np.sqrt(offset @ np.linalg.solve(pooled, offset)))


def _cut(image: Float64, side: int) -> Float64:
    """Return the blocks [n, side, side] of an image [H, W] of whole blocks, row by row."""
    rows, columns = image.shape[0] // side, image.shape[1] // side
    return image.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(-1, side, side)


@cache
def _pristine() -> tuple[Float64, Float64]:
    values = load_parameters("niqe")
    return values["mu"].ravel(), values["cov"]
