"""The draws against exact enumeration and against a plain loop over the hash."""

from __future__ import annotations

import itertools
from collections import Counter

import numpy as np

from spike4dgs.leaderboard.page.intervals import draw_weights, hashed


def lowbias32(x: int) -> int:
    """The published hash, in Python's integers."""
    x = (x ^ (x >> 16)) * 0x7FEB352D & 0xFFFFFFFF
    x = (x ^ (x >> 15)) * 0x846CA68B & 0xFFFFFFFF
    return x ^ (x >> 16)


def test_the_hash_is_the_published_one() -> None:
    counters = np.array([0, 1, 2, 77, 2**31, 2**32 - 1], np.uint32)
    assert hashed(counters, 9).tolist() == [lowbias32(int(c) ^ lowbias32(9)) for c in counters]


def test_a_replicate_is_what_a_loop_draws() -> None:
    images, seeds, most, replicates = (3, 2, 4), 2, 3, 50
    weights = draw_weights(images, seeds, most, replicates, True, 4).reshape(replicates, sum(images), seeds)
    stride = 1 + max(images) + most
    for r in range(replicates):
        expected = np.zeros((sum(images), seeds))
        for slot in range(3):
            bits = [lowbias32(((r * 3 + slot) * stride + j) ^ lowbias32(4)) for j in range(stride)]
            scene = bits[0] * 3 >> 32
            n = images[scene]
            for k, s in itertools.product(range(n), range(seeds)):
                image, seed = bits[1 + k] * n >> 32, bits[1 + max(images) + s] * seeds >> 32
                expected[sum(images[:scene]) + image, seed] += 1 / (3 * n * seeds)
        np.testing.assert_allclose(weights[r], expected, atol=1e-15)


def test_every_resample_of_three_images_comes_equally_often() -> None:
    replicates = 54_000
    weights = draw_weights((3,), 1, 1, replicates, False, 1)
    found = Counter(tuple(np.rint(3 * w).astype(int)) for w in weights)
    exact = Counter(tuple(draw.count(i) for i in range(3)) for draw in itertools.product(range(3), repeat=3))
    for counts, ways in exact.items():
        p = ways / 27
        assert abs(found[counts] / replicates - p) < 5 * np.sqrt(p * (1 - p) / replicates)
    assert set(found) == set(exact)


def test_weights_sum_to_one_and_scenes_count_once_where_they_are_not_drawn() -> None:
    drawn = draw_weights((5, 2), 3, 3, 200, True, 0)
    fixed = draw_weights((5, 2), 3, 3, 200, False, 0)
    np.testing.assert_allclose(drawn.sum(1), 1)
    np.testing.assert_allclose(fixed.reshape(200, 7, 3)[:, :5].sum((1, 2)), 0.5)
    assert drawn.reshape(200, 7, 3)[:, :5].sum((1, 2)).std() > 0.2


def test_other_numbers_of_seeds_share_the_draws_of_scenes_and_images() -> None:
    one = draw_weights((4, 3), 1, 3, 100, True, 2)
    three = draw_weights((4, 3), 3, 3, 100, True, 2).reshape(100, 7, 3).sum(2)
    np.testing.assert_allclose(one, three)
