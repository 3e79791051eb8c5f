"""The plane sweep's kernel against the same formula in numpy, in float32 to the bit and in float64."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from spike4dgs.baselines.initialization.plane_sweep import add_correlation

NOISE = 4e-4
Image = NDArray[np.floating]


def box(image: Image) -> Image:
    return np.asarray(cv2.boxFilter(image, -1, (5, 5), borderType=cv2.BORDER_REFLECT))


def moments(a: Image, b: Image) -> tuple[Image, ...]:
    return box(a), box(a * a) - box(a) ** 2, b, box(b), box(b * b), box(a * b)


def plain(a: Image, b: Image) -> tuple[Image, Image]:
    """Zero-mean normalised cross-correlation with noise in both variances, its positive part, inside of b's image."""
    mean_a, variance_a, b, mean_b, square_b, product = moments(a, b)
    spread = (variance_a + a.dtype.type(NOISE)) * (square_b - mean_b * mean_b + a.dtype.type(NOISE))
    inside = b >= 0
    return np.maximum((product - mean_a * mean_b) / np.sqrt(spread), 0) * inside, inside.astype(a.dtype)


def images(kind: str) -> tuple[Image, Image]:
    rng = np.random.default_rng(3)
    a = rng.random((60, 80), np.float32)
    b = np.clip(a + rng.normal(0, 0.2, a.shape), 0, None).astype(np.float32)
    if kind == "outside":
        b[:20], b[:, 50:] = -1, -1
    if kind == "flat":
        a[:30], b[20:50] = 0.7, 0.2
    if kind == "bright":
        a, b = a * 50, b * 50
    return a, b


@pytest.mark.parametrize("kind", ["random", "outside", "flat", "bright"])
def test_the_kernel_adds_what_numpy_does(kind: str) -> None:
    a, b = images(kind)
    total, seen = np.full(a.shape, 0.25, np.float32), np.ones(a.shape, np.float32)
    add_correlation(total, seen, *moments(a, b), np.float32(NOISE))
    score, inside = plain(a, b)
    np.testing.assert_array_equal(total, np.float32(0.25) + score)
    np.testing.assert_array_equal(seen, 1 + inside)
    exact, _ = plain(a.astype(np.float64), b.astype(np.float64))
    assert np.abs(total - 0.25 - exact).max() < (5e-2 if kind == "bright" else 2e-3)


def test_variances_that_rounding_makes_negative_prove_nothing() -> None:
    a = np.full((12, 12), 3000.0, np.float32)
    total, seen = np.zeros_like(a), np.zeros_like(a)
    add_correlation(total, seen, a, np.full_like(a, -1.0), a, a, a * a, a * a, np.float32(NOISE))
    assert not total.any() and (seen == 1).all()
