import math
import re

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from iqa_twin import asymmetric, half, leaves, luma, poster, symmetric
from iqa_twin import brisque_features as twin_features
from numpy.typing import NDArray
from PIL import Image
from scipy.optimize import brentq
from scipy.special import gamma
from small_scenes import shared_file

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.iqa import brisque
from spike4dgs.benchmark.metrics.iqa.brisque import brisque_features, score
from spike4dgs.benchmark.metrics.iqa.natural_scene_statistics import (
    fit_asymmetric,
    fit_symmetric,
    halve,
    load_parameters,
    neighbour_sums,
)

# The authors' MATLAB code on five photographs, and how far ours may be. I08 has six flat squares (2 % of its pixels),
# I19 is flat in 30 % of its pixels: there, MATLAB counts rounding noise by its sign (see the test below).
MATLAB = {"I03": (94.642, 0.01), "I04": (-0.108, 0.01), "I06": (0.993, 0.01), "I08": (5.358, 0.6), "I19": (72.26, 2.7)}
IMAGES = {
    "leaves": leaves(96, 144),
    "odd": leaves(95, 143, 3),
    "poster": poster(),
    "noise": np.random.default_rng(0).integers(0, 256, (64, 80)).astype(np.uint8),
    "small": leaves(14, 14),
    "row": leaves(15, 200),
}
RIGHT, BELOW, BELOW_RIGHT, BELOW_LEFT = (slice(2 + 4 * i, 6 + 4 * i) for i in range(4))  # of 18 features


def photograph(name: str) -> NDArray[np.uint8]:
    return luma(cv2.imread(str(shared_file(f"data/iqa/{name}.bmp"))))


def swapped(features: NDArray[np.float64], a: slice, b: slice) -> NDArray[np.float64]:
    """Two directions exchanged, at both scales."""
    scales = features.reshape(2, 18).copy()
    scales[:, a], scales[:, b] = scales[:, b].copy(), scales[:, a].copy()
    return scales.ravel()


@pytest.mark.parametrize("name", MATLAB)
def test_scores_are_the_authors(name: str) -> None:
    expected, tolerance = MATLAB[name]
    assert brisque(photograph(name)) == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize("name", ["I08", "I19"])
def test_what_differs_from_the_authors_is_the_sign_of_rounding_noise(name: str) -> None:
    """MATLAB's flat pixels are noise or zero by their gray level: its score lies between all noise and all zero."""
    image = photograph(name)
    all_noise, all_zero = score(twin_features(image, flat=1e-14)), brisque(image)
    assert all_noise < MATLAB[name][0] < all_zero


@pytest.mark.parametrize("name", IMAGES)
def test_features_are_the_definitions(name: str) -> None:
    np.testing.assert_allclose(brisque_features(IMAGES[name]), twin_features(IMAGES[name]), rtol=1e-9, atol=1e-12)


def test_regression_is_the_sum_over_support_vectors() -> None:
    p = load_parameters("brisque")
    features = brisque_features(IMAGES["leaves"])
    scaled = [2 * (f - low) / (high - low) - 1 for f, low, high in zip(features, *p["range"], strict=True)]
    total = -float(p["rho"])
    for vector, weight in zip(p["sv"], p["coef"], strict=True):
        square = sum((a - b) ** 2 for a, b in zip(scaled, vector, strict=True))
        total += weight * math.exp(-float(p["gamma"]) * square)
    assert score(features) == pytest.approx(total, abs=1e-9)
    assert brisque(IMAGES["leaves"]) == score(features)


@pytest.mark.parametrize("name", ["leaves", "poster"])
def test_features_do_not_depend_on_the_order_of_rows_and_columns(name: str) -> None:
    """The transposed image is filtered columns first; flat areas would show rounding noise."""
    image = IMAGES[name]
    expected = swapped(brisque_features(image), RIGHT, BELOW)
    np.testing.assert_allclose(brisque_features(np.ascontiguousarray(image.T)), expected, rtol=1e-9)


@pytest.mark.parametrize("name", ["leaves", "poster"])
def test_a_mirror_exchanges_the_diagonals_and_a_half_turn_changes_nothing(name: str) -> None:
    features = brisque_features(IMAGES[name])
    mirrored = brisque_features(np.ascontiguousarray(IMAGES[name][:, ::-1]))
    np.testing.assert_allclose(mirrored, swapped(features, BELOW_RIGHT, BELOW_LEFT), rtol=1e-9)
    turned = np.ascontiguousarray(IMAGES[name][::-1, ::-1])
    assert brisque(turned) == pytest.approx(brisque(IMAGES[name]), abs=1e-8)


@pytest.mark.parametrize("shape", [(40, 60), (41, 59), (3, 5)])
def test_halving_is_matlabs_bicubic(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(2).integers(0, 256, shape).astype(float)
    np.testing.assert_array_equal(halve(image), half(image))
    np.testing.assert_array_equal(halve(image.T), halve(image).T)


def test_halving_agrees_with_pillow_away_from_the_edge() -> None:
    image = leaves(64, 96).astype(np.float32)
    resized = np.asarray(Image.fromarray(image).resize((48, 32), Image.Resampling.BICUBIC))
    np.testing.assert_allclose(halve(image.astype(float))[2:-2, 2:-2], resized[2:-2, 2:-2], atol=1e-4)


def test_sums_are_those_of_the_shifted_products() -> None:
    blocks = np.random.default_rng(4).normal(size=(3, 5, 7))
    blocks[np.abs(blocks) < 0.3] = 0
    sums = neighbour_sums(blocks)
    for block, found in zip(blocks, sums, strict=True):
        for shift, row in zip(((0, 0), (0, -1), (-1, 0), (-1, -1), (-1, 1)), found, strict=True):
            v = block if shift == (0, 0) else block * np.roll(block, shift, (0, 1))
            expected = [np.abs(v).sum(), (v[v < 0] ** 2).sum(), (v[v > 0] ** 2).sum(), (v < 0).sum(), (v > 0).sum()]
            np.testing.assert_allclose(row, expected, rtol=1e-12)


@settings(deadline=None)
@given(st.integers(200, 10000), st.floats(0.01, 10), st.floats(0.1, 10))
def test_fits_recover_a_distribution_from_its_exact_moments(thousandths: int, left: float, skew: float) -> None:
    shape, right = thousandths / 1000, left * skew
    share = left / (left + right)  # of the values that are negative
    square, mean_abs = gamma(3 / shape) / gamma(1 / shape), gamma(2 / shape) / gamma(1 / shape)
    squares = square * share * left**2, square * (1 - share) * right**2
    sums = 1000 * np.array([mean_abs * (share * left + (1 - share) * right), *squares, share, 1 - share])
    fit = fit_asymmetric(sums, 1000)
    assert float(fit.shape) == shape
    assert float(fit.left) == pytest.approx(left * math.sqrt(square), rel=1e-9)
    assert float(fit.right) == pytest.approx(right * math.sqrt(square), rel=1e-9)
    assert float(fit.mean) == pytest.approx((right - left) * mean_abs, rel=1e-9, abs=1e-12)
    np.testing.assert_allclose(fit.scales, (left, right), rtol=1e-9)


@settings(deadline=None)
@given(st.integers(200, 10000), st.floats(0.01, 10))
def test_symmetric_fits_recover_a_distribution_from_its_exact_moments(thousandths: int, scale: float) -> None:
    shape = thousandths / 1000
    variance = scale**2 * gamma(3 / shape) / gamma(1 / shape)
    sums = np.array([scale * gamma(2 / shape) / gamma(1 / shape), variance / 2, variance / 2, 0.5, 0.5])
    found = fit_symmetric(1000 * sums, 1000)
    assert found == (shape, pytest.approx(variance, rel=1e-12))


@pytest.mark.parametrize("shape", [0.3, 0.8, 1.0, 2.0, 5.0])
def test_fits_of_samples_are_the_search_of_the_grid_and_the_root_of_the_equation(shape: float) -> None:
    rng = np.random.default_rng(5)
    values = rng.gamma(1 / shape, size=20000) ** (1 / shape) * rng.choice([-1.0, 1.0, 1.0], 20000)
    (sums,) = neighbour_sums(values.reshape(1, 100, 200))
    a, variance = fit_symmetric(sums[0], values.size)
    assert (a, variance) == pytest.approx(symmetric(values), abs=1e-9)
    fit = fit_asymmetric(sums[0], values.size)
    assert (fit.shape, fit.left, fit.right) == pytest.approx(asymmetric(values), abs=1e-9)

    def excess(x: float) -> float:
        ratio = np.mean(values**2) / np.mean(np.abs(values)) ** 2
        return float(gamma(1 / x) * gamma(3 / x) / gamma(2 / x) ** 2 - ratio)

    assert a == pytest.approx(brentq(excess, 0.2, 10), abs=0.0006)
    assert a == pytest.approx(shape, rel=0.08)  # few of the large values that shape 0.3 allows are drawn


@pytest.mark.parametrize(
    ("image", "expected", "found"),
    [
        (np.zeros((20, 20)), "a gray 8-bit image (H, W)", "float64 of shape (20, 20)"),
        (np.zeros((20, 20, 3), np.uint8), "a gray 8-bit image (H, W)", "uint8 of shape (20, 20, 3)"),
        (np.zeros((13, 20), np.uint8), "at least 14x14 pixels", "(13, 20)"),
        (np.full((20, 20), 7, np.uint8), "an image with texture", "7 everywhere"),
        (np.repeat([[0, 255]], 20, axis=0).repeat(20, axis=1).astype(np.uint8), "an image with texture", "hardly any"),
    ],
)
def test_what_has_no_score_is_refused(image: NDArray[np.uint8], expected: str, found: str) -> None:
    with pytest.raises(UserError, match=re.escape(f"cam_08/000120: expected {expected}, found {found}; ")):
        brisque(image, where="cam_08/000120")
