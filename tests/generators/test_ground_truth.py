"""The moving region of a ground-truth image."""

from __future__ import annotations

import numpy as np

from spike4dgs.generators.truth import moving_region


def test_moving_region_has_the_object_and_its_moving_shadow_only():
    background = np.full((30, 40), 0.5, np.float32)
    mask = np.zeros((30, 40), bool)
    mask[10:15, 10:15] = True
    image, varies = background.copy(), np.zeros((30, 40), bool)
    image[20:25, 5:20] = 0.3
    varies[:, :12] = True  # the right part of the shadow does not move
    image[2, 2] = 0.9  # a speck of noise
    expected = np.zeros((30, 40), bool)
    expected[8:17, 8:17] = True
    expected[20:25, 5:12] = True
    assert np.array_equal(moving_region(mask, image, background, varies), expected)
