from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.metrics.held_out_spikes import time_mean


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 60), min_size=1, max_size=5, unique=True), st.integers(0, 2**32 - 1))
def test_it_is_the_mean_of_a_dense_interpolation(ticks: list[int], seed: int) -> None:
    rng, ticks = np.random.default_rng(seed), sorted(ticks)
    images = rng.random((len(ticks), 2, 3))
    start = rng.uniform(-20, 60, (2, 3))
    stop = start + rng.uniform(1, 60, (2, 3))
    found = time_mean(ticks, list(images), start, stop)
    for index in np.ndindex(2, 3):
        times = start[index] + (np.arange(20000) + 0.5) / 20000 * (stop[index] - start[index])
        dense = np.interp(times, ticks, images[(slice(None), *index)])
        np.testing.assert_allclose(found[index], dense.mean(), atol=1e-6)


def test_one_window_for_all_pixels_and_images_that_stay_as_they_are() -> None:
    images = [np.full((2, 2), v) for v in (0.2, 0.6, 0.4)]
    before = [image.copy() for image in images]
    np.testing.assert_allclose(time_mean([0, 10, 20], images, 5, 15), np.full((2, 2), (0.5 + 0.55) / 2))
    np.testing.assert_allclose(time_mean([0, 10, 20], images, -9, -3), images[0])
    np.testing.assert_allclose(time_mean([0, 10, 20], images, 40, 50), images[2])
    np.testing.assert_array_equal(images, before)
