"""SIFT's matches of an image and the same image shifted."""

import numpy as np
from scipy.ndimage import gaussian_filter, shift

from spike4dgs.studies.poses.sift import sift_matches


def test_sift_matches_a_shifted_image_both_ways() -> None:
    image = gaussian_filter(np.random.default_rng(3).normal(size=(100, 140)), 1.5)
    first = np.asarray(image / np.abs(image).max(), np.float32)
    second = shift(first, (4, 6), order=1, mode="nearest")
    matches = sift_matches(np.stack([first, second]))
    assert set(matches) == {(0, 1), (1, 0)}
    for pair, moved in (((0, 1), (6, 4)), ((1, 0), (-6, -4))):
        m = matches[pair]
        assert len(m.point) > 50
        assert np.median(np.linalg.norm(m.uv - m.at - moved, axis=1)) < 0.2
