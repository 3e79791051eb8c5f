"""Lens distortion against OpenCV, on random and on hard lenses; resampling of images."""

import cv2
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.scene.lens import distort, fold_radius, inside, make_distortion, nearest, resample, undistort

LENSES = st.tuples(
    st.floats(-0.5, 0.5), st.floats(-0.3, 0.3), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.floats(-0.2, 0.2)
)


def by_opencv(xy: np.ndarray, lens: tuple[float, ...]) -> np.ndarray:
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(lens))[0].reshape(-1, 2)


def one_to_one_radius(lens: tuple[float, ...]) -> float:
    """The radius up to which the radial terms' derivatives outweigh the tangential ones', at most that of the fold.

    On such a disc the derivatives, which are symmetric, are positive definite: no two points have one image.
    """
    k1, k2, p1, p2, k3 = lens
    radii = np.linspace(0, min(fold_radius(lens), 2), 2000)
    s = radii**2
    along, across = 1 + s * (3 * k1 + s * (5 * k2 + s * 7 * k3)), 1 + s * (k1 + s * (k2 + s * k3))
    bad = np.minimum(along, across) <= 6 * np.hypot(p1, p2) * radii
    return float(radii[np.argmax(bad)]) if bad.any() else float(radii[-1])


@settings(max_examples=60, deadline=None)
@given(LENSES, st.integers(0, 2**31))
@example((-0.4375, -0.046875, 0.0, 0.009765625, 0.078125), 0)  # folds before its radial terms do
def test_distortion_is_opencvs_and_its_inverse_is_exact(values: tuple[float, ...], seed: int) -> None:
    lens = make_distortion(values)
    assume(lens)
    xy = np.random.default_rng(seed).uniform(-0.9, 0.9, (100, 2))
    xy = xy[np.linalg.norm(xy, axis=1) < 0.95 * fold_radius(lens)]
    bent = distort(xy, lens)
    np.testing.assert_allclose(bent, by_opencv(xy, lens), atol=1e-13)
    found = undistort(bent, lens)
    np.testing.assert_allclose(distort(found, lens), bent, atol=2e-9)
    alone = np.linalg.norm(xy, axis=1) < 0.95 * one_to_one_radius(lens)  # beyond, two points may have one image
    np.testing.assert_allclose(found[alone], xy[alone], atol=1e-9)


def test_nothing_is_seen_beyond_the_fold() -> None:
    lens = make_distortion([-0.3])
    fold = fold_radius(lens)
    assert fold == pytest.approx(1 / np.sqrt(0.9))  # 1 + 3 k1 r^2 = 0
    x = np.array([[0.99 * fold, 0], [1.01 * fold, 0], [2.0, 0], [1e200, 0]])
    np.testing.assert_array_equal(np.isnan(distort(x, lens)).any(axis=1), [False, True, True, True])
    largest = fold * (1 - 0.3 * fold**2)
    bent = np.array([[0.999 * largest, 0], [1.001 * largest, 0], [5.0, 5.0], [0.0, 0.0]])
    np.testing.assert_array_equal(np.isnan(undistort(bent, lens)).any(axis=1), [False, True, True, False])
    assert fold_radius(make_distortion([0.1])) == np.inf


def test_coefficients_are_five_or_none() -> None:
    assert make_distortion([-0.1]) == (-0.1, 0.0, 0.0, 0.0, 0.0)
    assert make_distortion([]) == make_distortion([0.0] * 5) == ()
    with pytest.raises(ValueError, match="6 coefficients"):
        make_distortion([0.0] * 6)


def test_resampling_reproduces_smooth_images_and_pixels() -> None:
    v, u = np.mgrid[:40, :60] + 0.5
    image = (0.5 + 0.3 * np.sin(u / 6) * np.cos(v / 5)).astype(np.float32)
    grid = np.stack([u, v], axis=-1)
    np.testing.assert_allclose(resample(image, grid), image, atol=1e-6)
    at = grid[6:-6, 6:-6] + np.random.default_rng(0).uniform(-0.5, 0.5, (28, 48, 2))
    expected = 0.5 + 0.3 * np.sin(at[..., 0] / 6) * np.cos(at[..., 1] / 5)
    assert np.abs(resample(image, at) - expected).max() < 1e-4
    np.testing.assert_array_equal(nearest(image, grid + 0.49), image)


def test_pixels_that_are_no_numbers_stay_where_they_are() -> None:
    image = np.full((20, 30), 0.5, np.float32)
    image[4, 7] = np.nan
    grid = np.stack(np.meshgrid(np.arange(30) + 0.5, np.arange(20) + 0.5), axis=-1)
    moved = resample(image, grid + (0.25, 0.0))
    assert np.argwhere(np.isnan(moved)).tolist() == [[4, 7]]
    np.testing.assert_allclose(moved[np.isfinite(moved)], 0.5, atol=1e-6)
    assert np.isnan(resample(np.full_like(image, np.nan), grid)).all()


def test_a_position_beyond_the_border_is_outside() -> None:
    at = np.array([[0.0, 0.0], [30.0, 20.0], [-0.1, 3.0], [30.1, 3.0], [np.nan, 3.0]])
    np.testing.assert_array_equal(inside(at, 30, 20), [True, True, False, False, False])
