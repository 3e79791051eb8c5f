"""Rank intervals against closed forms, exact enumeration, and simulations with known ranks."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from statistics import NormalDist

import numpy as np
import pytest

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.leaderboard.page import intervals, pair_kernels
from spike4dgs.leaderboard.page.intervals import GRID, LEVEL, MOST_UNITS, compare, draw_weights, resampled_means


def scored(values: Float64) -> list[list[Float64]]:
    """Scores [M, scenes, images] as methods, scenes, [images, one seed]."""
    return [[scene[:, None] for scene in method] for method in values]


def test_the_standard_error_of_a_mean_is_sigma_by_root_n() -> None:
    values = np.random.default_rng(0).gamma(2, size=(1, 1, 30))
    draws = resampled_means(scored(values), False, replicates=20_000)
    exact = values.std() / math.sqrt(30)  # the bootstrap's population is the sample: n, not n - 1
    assert draws.std() == pytest.approx(exact, rel=4 / math.sqrt(2 * 20_000))
    assert draws.mean() == pytest.approx(values.mean(), abs=4 * exact / math.sqrt(20_000))


def test_tiny_cases_against_all_resamples() -> None:
    """Three scenes of two images: 27 draws of scenes, and 4 of images for each drawn scene."""
    values = np.array([[0.0, 1.0], [4.0, 6.0], [9.0, 9.5]])
    pairs = list(itertools.product(range(2), repeat=2))
    exact = [
        np.mean([values[scene, list(pair)].mean() for scene, pair in zip(scenes, images, strict=True)])
        for scenes in itertools.product(range(3), repeat=3)
        for images in itertools.product(pairs, repeat=3)
    ]
    draws = resampled_means(scored(values[None]), True, replicates=40_000)[:, 0]
    assert draws.std() == pytest.approx(np.std(exact), rel=0.02)
    for q in np.quantile(exact, (0.05, 0.25, 0.5, 0.75, 0.95)):
        assert np.mean(draws <= q) == pytest.approx(np.mean(exact <= q), abs=0.01)


def test_seeds_add_their_variance() -> None:
    values = np.random.default_rng(3).normal(size=(6, 4))  # images, seeds
    images, seeds = values.mean(1), values.mean(0)
    draws = resampled_means([[values]], False, replicates=40_000)[:, 0]
    rest = values - images[:, None] - seeds[None] + values.mean()
    # Images and seeds are crossed: each is drawn with replacement, so their variances add, and that of their product.
    exact = images.var() / 6 + seeds.var() / 4 + rest.var() / 24
    assert draws.var() == pytest.approx(exact, rel=0.03)


def test_the_draws_are_paired() -> None:
    """A constant difference has no error, however much the images vary."""
    base = np.random.default_rng(1).normal(scale=10, size=(4, 12))
    found = compare(scored(np.stack([base, base + 0.01, base])), True)
    assert found.half_widths.max() < 1e-6
    assert found.best_ranks.tolist() == [2, 1, 2] and found.worst_ranks.tolist() == [3, 1, 3]
    assert found.tied(0) == [2] and found.tied(1) == []


def test_lower_is_better_turns_the_ranks_around() -> None:
    values = np.arange(3)[:, None, None] + np.random.default_rng(2).normal(scale=0.01, size=(3, 5, 9))
    assert compare(scored(values), True).best_ranks.tolist() == [3, 2, 1]
    assert compare(scored(values), False).best_ranks.tolist() == [1, 2, 3]


def test_critical_values_are_widened_to_students() -> None:
    at = dict(zip(GRID.round(9), intervals.widened_values(5), strict=True))
    assert at[2.0] == pytest.approx(math.sqrt(5 / 4) * 2.8693, rel=1e-3)  # t of 4 degrees with the tail 0.02275
    assert np.abs(intervals.widened_values(MOST_UNITS) / GRID - 1).max() < 0.25


def test_of_a_single_image_nothing_is_told_and_a_method_alone_has_rank_one() -> None:
    found = compare(scored(np.array([[[1.0]], [[2.0]]])), True)
    assert found.best_ranks.tolist() == [1, 1] and found.worst_ranks.tolist() == [2, 2]
    found = compare(scored(np.ones((1, 2, 3))), True)
    assert found.best_ranks.tolist() == found.worst_ranks.tolist() == [1]


@pytest.mark.parametrize(
    ("n_scenes", "effects", "images"),
    [(5, (0.0,) * 6, 8), (12, (2.0, 1.0, 1.0, 0.5, 0.0, 0.0), 8), (5, (0.0,) * 24, 1)],
    ids=["equal", "some", "many"],
)
def test_intervals_cover_known_ranks(n_scenes: int, effects: tuple[float, ...], images: int) -> None:
    """Methods differ by known effects, scenes and images add noise; the true ranks are in the intervals as promised."""
    truth, rng, trials = np.array(effects), np.random.default_rng(n_scenes), 150
    best = 1 + (truth[None] > truth[:, None]).sum(1)  # of methods that are equal any order is right:
    worst = len(truth) - (truth[None] < truth[:, None]).sum(1)
    covered, separated = 0, 0.0
    for trial in range(trials):
        scenes = rng.normal(size=(1, n_scenes, 1)) * 3
        by_scene = rng.normal(size=(len(truth), n_scenes, 1)) * 0.5
        noise = rng.normal(size=(len(truth), n_scenes, images)) * 0.3
        found = compare(scored(truth[:, None, None] + scenes + by_scene + noise), True, replicates=400, seed=trial)
        # Each pair in the wrong order would put a true rank outside of some interval.
        covered += bool((found.best_ranks <= best).all() and (found.worst_ranks >= worst).all())
        separated += found.better.mean()
    error = math.sqrt(LEVEL * (1 - LEVEL) / trials)
    assert covered / trials > LEVEL - 3 * error
    if any(effects):
        assert separated / trials > 0.2, "they also tell methods apart"
    else:
        assert covered / trials < 1, "and they are not so wide that they never err"


def test_variants_of_a_world_are_not_independent_scenes() -> None:
    """27 scenes of nine worlds, whose variants differ little: joint intervals hold, and are those of nine scenes."""
    rng, worlds, trials, covered = np.random.default_rng(7), [str(s // 3) for s in range(27)], 100, 0
    for trial in range(trials):
        of_world = rng.normal(size=(6, 9, 1))
        values = np.repeat(of_world, 3, axis=1) + rng.normal(size=(6, 27, 1)) * 0.5
        covered += not compare(scored(values), True, worlds, replicates=400, seed=trial).better.any()
    assert covered / trials > LEVEL - 3 * math.sqrt(LEVEL * (1 - LEVEL) / trials)
    nine, same = (compare(scored(v), True, w) for v, w in ((of_world, None), (np.repeat(of_world, 3, axis=1), worlds)))
    np.testing.assert_allclose(same.half_widths, nine.half_widths, rtol=0.1)
    np.testing.assert_allclose(same.means, nine.means)


def test_of_two_worlds_only_images_are_drawn() -> None:
    """However many variants they have."""
    values = np.random.default_rng(8).normal(size=(3, 6, 9))
    two = compare(scored(values), True, list("aaabbb"))
    draws = resampled_means(scored(values), False) - values.mean((1, 2))
    assert two.half_widths == pytest.approx(intervals._half_widths(draws, 54))


def test_all_pairs_hold_together() -> None:
    pairs = {2: 1, 5: 10, 24: 276}
    for methods, count in pairs.items():
        one = NormalDist().inv_cdf(1 - (1 - LEVEL) / 2 / count)
        assert intervals.joint_value(methods) == pytest.approx(one, rel=2e-4)


def lowbias32(x: int) -> int:
    """The published hash, in Python's integers."""
    x = (x ^ (x >> 16)) * 0x7FEB352D & 0xFFFFFFFF
    x = (x ^ (x >> 15)) * 0x846CA68B & 0xFFFFFFFF
    return x ^ (x >> 16)


def test_the_hash_is_the_published_one() -> None:
    counters = np.array([0, 1, 2, 77, 2**31, 2**32 - 1], np.uint32)
    assert intervals.hashed(counters, 9).tolist() == [lowbias32(int(c) ^ lowbias32(9)) for c in counters]


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


@pytest.mark.parametrize("methods", [2, 31, 32, 33, 70])
def test_the_compiled_pairs_are_those_of_numpy(methods: int) -> None:
    deviations = np.random.default_rng(methods).normal(size=(500, methods))
    deviations[:, -1] = deviations[:, 0]  # no error
    deviations[:, methods // 2] = deviations[:, 0] + 1e-9 * deviations[:, 1]
    errors, largest = pair_kernels.pair_statistics(deviations)
    expected_errors, expected_largest = intervals.pair_statistics(deviations)
    np.testing.assert_allclose(errors, expected_errors, rtol=1e-14)
    np.testing.assert_allclose(largest, expected_largest, rtol=1e-14)


def test_many_methods_are_compared_as_few_are(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(5).normal(size=(40, 5, 9)) + np.arange(40)[:, None, None] / 4
    few = compare(scored(values), True)
    monkeypatch.setattr(intervals, "FEW", 1)
    many = compare(scored(values), True)
    assert (few.better == many.better).all() and few.better.any()
    assert few.best_ranks is few.best_ranks  # counted once, not for each row of a table
