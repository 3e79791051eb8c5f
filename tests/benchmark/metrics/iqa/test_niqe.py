import re

import cv2
import numpy as np
import pytest
from iqa_twin import leaves, luma, poster
from iqa_twin import niqe_features as twin_features
from numpy.typing import NDArray
from scipy.linalg import pinvh
from scipy.spatial.distance import mahalanobis
from small_scenes import shared_file

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.iqa import niqe
from spike4dgs.benchmark.metrics.iqa.natural_scene_statistics import load_parameters
from spike4dgs.benchmark.metrics.iqa.niqe import distance, niqe_features

# The authors' MATLAB code on five photographs; the flat pixels of I08 and I19 matter less here than for BRISQUE.
MATLAB = {"I03": 15.754, "I04": 3.655, "I06": 3.235, "I08": 3.184, "I19": 8.635}
PRISTINE = load_parameters("niqe")


@pytest.mark.parametrize("name", MATLAB)
def test_scores_are_the_authors(name: str) -> None:
    image = luma(cv2.imread(str(shared_file(f"data/iqa/{name}.bmp"))))
    assert niqe(image) == pytest.approx(MATLAB[name], abs=0.04)


@pytest.mark.parametrize("image", [leaves(), poster(192, 192)], ids=["leaves", "poster"])
def test_features_are_the_definitions(image: NDArray[np.uint8]) -> None:
    np.testing.assert_allclose(niqe_features(image), twin_features(image), rtol=1e-9, atol=1e-12)


def test_distance_is_mahalanobis_with_the_mean_of_both_covariances() -> None:
    features = niqe_features(leaves())
    covariance = (PRISTINE["cov"] + np.cov(features.T)) / 2
    expected = mahalanobis(PRISTINE["mu"][0], features.mean(axis=0), pinvh(covariance))
    assert distance(features) == pytest.approx(expected, rel=1e-6)
    assert niqe(leaves()) == distance(features)


def test_distance_of_pristine_features_is_small_and_grows_with_an_offset() -> None:
    rng = np.random.default_rng(0)
    features = rng.multivariate_normal(PRISTINE["mu"][0], PRISTINE["cov"], 5000)
    assert distance(features) < 0.2
    step = np.linalg.cholesky(PRISTINE["cov"])[:, 0]  # one standard deviation
    assert distance(features + 3 * step) == pytest.approx(3, abs=0.2)


@pytest.mark.parametrize("image", [leaves(), poster(192, 192)], ids=["leaves", "poster"])
def test_a_half_turn_changes_nothing(image: NDArray[np.uint8]) -> None:
    """Blocks are counted from the other end, and the filters run the other way."""
    turned = np.ascontiguousarray(image[::-1, ::-1])
    np.testing.assert_allclose(niqe_features(turned), niqe_features(image)[::-1], rtol=1e-9)
    assert niqe(turned) == pytest.approx(niqe(image), rel=1e-8)


def test_a_transposed_image_has_the_same_blocks_with_two_directions_exchanged() -> None:
    image = poster(192, 192)
    features = niqe_features(image).reshape(4, 2, 18)
    transposed = niqe_features(np.ascontiguousarray(image.T)).reshape(4, 2, 18)
    order = [0, 1, 6, 7, 8, 9, 2, 3, 4, 5, *range(10, 18)]
    np.testing.assert_allclose(transposed[[0, 2, 1, 3]], features[..., order], rtol=1e-9)


def test_pixels_beyond_whole_blocks_are_not_used() -> None:
    image = leaves(200, 300)
    assert niqe(image) == niqe(np.ascontiguousarray(image[:192, :288]))


def test_blocks_without_texture_are_left_out() -> None:
    image = leaves(96, 4 * 96)
    image[:, :192] = 40  # the second block's last columns see the texture of the third
    features = niqe_features(image)
    usable = np.isfinite(features).all(axis=1)
    assert not usable[0] and usable[2:].all()
    assert niqe(image) == distance(features[usable])


def stripes(width: int) -> NDArray[np.uint8]:
    """Only the right half of the last block has texture."""
    image = np.full((96, width), 40, np.uint8)
    image[:, -48:] = leaves(96, 48)
    return image


@pytest.mark.parametrize(
    ("image", "expected", "found"),
    [
        (np.zeros((200, 200), np.float32), "a gray 8-bit image (H, W)", "float32 of shape (200, 200)"),
        (np.zeros((200, 200, 3), np.uint8), "a gray 8-bit image (H, W)", "uint8 of shape (200, 200, 3)"),
        (leaves(95, 300), "at least 96x96 pixels", "(95, 300)"),
        (np.full((96, 192), 7, np.uint8), "an image with texture", "7 everywhere"),
        (leaves(191, 191), "at least two blocks of 96x96 pixels with texture", "1 of 1"),
        (stripes(192), "at least two blocks of 96x96 pixels with texture", "1 of 2"),
    ],
)
def test_what_has_no_score_is_refused(image: NDArray[np.uint8], expected: str, found: str) -> None:
    with pytest.raises(UserError, match=re.escape(f"cam_08/000120: expected {expected}, found {found}; ")):
        niqe(image, where="cam_08/000120")
