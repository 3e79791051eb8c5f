"""Rank intervals: which methods a benchmark can tell apart, by a paired bootstrap over scenes, images and seeds.

All methods are scored on the same images, so a replicate draws the same scenes and images for all of them, and what
counts is the differences of their means. The intervals of all differences hold together (max-t: Romano and Wolf 2005),
with probability LEVEL. From them follow the intervals of the ranks (Mogstad, Romano, Shaikh and Wilhelm, "Inference for
Ranks", Review of Economic Studies 2024): a method's rank is at best one more than the number of those that beat it. Two
methods tie where the interval of their difference contains 0.

A bootstrap of few scenes gives intervals that are too narrow. They are widened by sqrt(n / (n - 1)), and the critical
value is taken from Student's distribution with n - 1 degrees of freedom in place of the normal one (Hesterberg, "What
Teachers Should Know about the Bootstrap", The American Statistician 2015), where n counts what is resampled first. The
tail is that of the simultaneous critical value, not of a single interval.

A bootstrap of few scenes does not see how many differences there are: the largest of hundreds is that of the few
patterns that n scenes allow. The critical value is therefore at least Bonferroni's for so many pairs. In simulations of
equal methods all intervals of 24 on five scenes then hold in 9 of 10 cases; they held in a third of them without.

Variants of a world are alike: where methods differ on one, they differ on the others. So worlds are drawn, and within
them the images of all their scenes. Below FEWEST_WORLDS worlds are not resampled: then an interval is about these
scenes and not about others like them. Images of a scene follow each other in time. They are drawn as if they did not
depend on each other, which makes the intervals of less than FEWEST_WORLDS worlds too narrow where errors last over
several images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import numpy as np

from spike4dgs.benchmark.arrays import Float64, Int64, Mask, UInt32


def hashed(counters: UInt32, seed: int) -> UInt32:
    """Return 32 random bits for each counter: lowbias32(counter ^ lowbias32(seed))."""
    return _lowbias32(counters ^ _lowbias32(np.array(seed, np.uint32)))


def _lowbias32(x: UInt32) -> UInt32:
    """Return a bijection of 32 bits (C. Wellons, hash-prospector), which the page's JavaScript has too."""
    with np.errstate(over="ignore"):
        x = (x ^ (x >> np.uint32(16))) * np.uint32(0x7FEB352D)
        x = (x ^ (x >> np.uint32(15))) * np.uint32(0x846CA68B)
    return np.asarray(x ^ (x >> np.uint32(16)))


@lru_cache(maxsize=4)  # the metrics of a board have the same images
def draw_weights(
    images: tuple[int, ...], seeds: int, most_seeds: int, replicates: int, scenes: bool, seed: int
) -> Float64:
    """Return the weights [replicates, sum(images) * seeds] of resampled means over scenes, their images and seeds.

    A replicate draws as many scenes as there are with replacement, for each of them its images, and for each its seeds.
    Its mean is the mean over the drawn scenes of the mean over the drawn images and seeds, so weights sum to 1.

    `images` has the number of each scene's. `most_seeds`, the largest number of any method's, lets methods share the
    draws of scenes and images. Without `scenes` each scene counts once.
    """
    n_scenes, longest = len(images), max(images)
    stride = 1 + longest + most_seeds
    counters = np.arange(replicates * n_scenes * stride, dtype=np.uint32).reshape(replicates, n_scenes, stride)
    bits = hashed(counters, seed).astype(np.uint64)
    sizes = np.asarray(images, np.uint64)
    slots = np.arange(n_scenes)
    drawn = (bits[:, :, 0] * np.uint64(n_scenes) >> np.uint64(32)).astype(np.intp) if scenes else slots[None]
    drawn = np.broadcast_to(drawn, (replicates, n_scenes))
    offsets = np.concatenate([[0], np.cumsum(images)])
    weights = np.zeros((replicates, int(offsets[-1]), seeds))
    rows = np.arange(replicates)
    for slot in slots:
        scene = drawn[:, slot]
        size = sizes[scene]
        by_seed = np.zeros((replicates, seeds))
        for k in range(seeds):
            pick = (bits[:, slot, 1 + longest + k] * np.uint64(seeds) >> np.uint64(32)).astype(np.intp)
            by_seed[rows, pick] += 1 / seeds
        for k in range(longest):
            pick = (bits[:, slot, 1 + k] * size >> np.uint64(32)).astype(np.intp)
            share = np.where(k < size, 1 / (n_scenes * size), 0)
            weights[rows, offsets[scene] + np.minimum(pick, size.astype(np.intp) - 1)] += share[:, None] * by_seed
    return weights.reshape(replicates, -1)


LEVEL = 0.95
REPLICATES = 2000
SEED = 20251
FEWEST_WORLDS = 3  # two have one difference: no spread can be estimated from it
FEW = 100  # methods whose pairs are compared without compiled loops
MOST_UNITS = 60  # of the table of widened critical values: more units count as so many
GRID = np.linspace(1, 6, 51)  # critical values of the table; it is interpolated, as on the page


@dataclass(frozen=True)
class Comparison:
    """Methods compared by one metric on the same images.

    `means` [M]; `half_widths` [M, M] of the intervals of their differences; `better` [M, M]: i is better than j by more
    than that; `best_ranks` and `worst_ranks` [M], from 1.
    """

    means: Float64
    half_widths: Float64
    better: Mask

    @cached_property
    def best_ranks(self) -> Int64:
        """One more than the number of methods that are better."""
        return np.asarray(1 + self.better.sum(0))

    @cached_property
    def worst_ranks(self) -> Int64:
        """The number of methods, less those that are worse."""
        return np.asarray(len(self.means) - self.better.sum(1))

    def tied(self, i: int) -> list[int]:
        """Return the methods that cannot be told from method `i`."""
        tied = ~(self.better[i] | self.better[:, i])
        tied[i] = False
        return list(np.flatnonzero(tied).tolist())


def resampled_means(
    values: Sequence[Sequence[Float64]], scenes: bool, replicates: int = REPLICATES, seed: int = SEED
) -> Float64:
    """Return the resampled means [replicates, M] of methods.

    `values`: for each method and scene its scores [images, seeds]. All methods have the same scenes and images; a
    method has the same number of seeds on all scenes.
    """
    images = tuple(len(scene) for scene in values[0])
    seeds = [method[0].shape[1] for method in values]
    found = np.empty((replicates, len(values)))
    for n in sorted(set(seeds)):
        columns = [m for m, count in enumerate(seeds) if count == n]
        weights = draw_weights(images, n, max(seeds), replicates, scenes, seed)
        flat = np.stack([np.concatenate(values[m]).reshape(-1) for m in columns], axis=1)
        # Not a matrix product of BLAS, whose threads wait for each other on a busy machine.
        found[:, columns] = np.einsum("ru,um->rm", weights, flat)
    return found


@cache
def widened_values(n: int) -> Float64:
    """Return the critical values for `n` resampled units in the place of those in GRID, of four digits.

    sqrt(n / (n - 1)) times the value that Student's t with n - 1 degrees of freedom exceeds as rarely as a normal
    number does the given one.

    >>> f"{np.interp(1.96, GRID, widened_values(5)):.2f} {np.interp(2.9, GRID, widened_values(5)):.2f}"
    '3.11 6.78'
    """
    from scipy.special import ndtr, stdtrit  # what scipy.stats has as norm.sf and t.isf, which takes longer to import

    if not 2 <= n <= MOST_UNITS:
        raise ValueError(f"2 to {MOST_UNITS} units expected, found {n}")
    values = -np.sqrt(n / (n - 1)) * stdtrit(n - 1, ndtr(-GRID))
    return np.array([float(f"{v:.4g}") for v in values])


def joint_value(methods: int) -> float:
    """Return Bonferroni's critical value of a normal number for all pairs of so many methods, of four digits.

    >>> joint_value(2), joint_value(24)
    (1.96, 3.744)
    """
    from scipy.special import ndtri

    pairs = max(methods * (methods - 1) // 2, 1)
    return float(f"{-ndtri((1 - LEVEL) / 2 / pairs):.4g}")


def by_world(values: Sequence[Sequence[Float64]], worlds: Sequence[object]) -> list[list[Float64]]:
    """Return the scores of methods by world: those of its scenes, one below the other. `worlds` has each scene's."""
    names = dict.fromkeys(worlds)
    return [
        [np.concatenate([scene for scene, w in zip(method, worlds, strict=True) if w == world]) for world in names]
        for method in values
    ]


def compare(
    values: Sequence[Sequence[Float64]],
    higher_is_better: bool,
    worlds: Sequence[str] | None = None,
    replicates: int = REPLICATES,
    seed: int = SEED,
) -> Comparison:
    """Compare methods by their scores, given as in `resampled_means`.

    `worlds` has the world of each scene; each scene is one if left out. They are drawn too if they are enough.
    """
    drawn = by_world(values, worlds or range(len(values[0])))
    resampled = len(drawn[0]) >= FEWEST_WORLDS
    drawn = drawn if resampled else [list(method) for method in values]
    means, centres = (np.array([np.mean([of.mean() for of in method]) for method in v]) for v in (values, drawn))
    draws = resampled_means(drawn, resampled, replicates, seed)
    units = len(drawn[0]) if resampled else sum(len(scene) for scene in drawn[0])
    half = _half_widths(draws - centres, units)
    difference = means[:, None] - means[None]
    better = (difference if higher_is_better else -difference) > half
    return Comparison(means, half, better)


def _half_widths(deviations: Float64, units: int) -> Float64:
    """Return the half widths [M, M] of simultaneous intervals of all differences, from deviations [R, M] of means.

    They are infinite for a single unit, of which there is no spread.
    """
    replicates, n = deviations.shape
    if n > FEW:
        from spike4dgs.leaderboard.page import pair_kernels  # numba takes longer to import than few methods take

        errors, largest = pair_kernels.pair_statistics(deviations)
    else:
        errors, largest = pair_statistics(deviations)
    # The smallest value that at least LEVEL of the replicates do not exceed, without interpolation, as on the page.
    critical = max(np.sort(largest)[int(np.ceil(LEVEL * replicates)) - 1], joint_value(n))
    if units < 2:
        return np.where(np.eye(n) > 0, 0, np.inf)
    wide = np.interp(critical, GRID, widened_values(min(units, MOST_UNITS)))
    return np.asarray((errors + errors.T) * wide)


def pair_statistics(deviations: Float64) -> tuple[Float64, Float64]:
    """Return two statistics of all pairs of methods, from deviations [R, M] of their means.

    These are the standard errors [M, M] of the differences, for methods i < j and 0 elsewhere, and for each replicate
    [R] the largest difference in units of its error.
    """
    replicates, n = deviations.shape
    errors, largest = np.zeros((n, n)), np.zeros(replicates)
    for i in range(n - 1):
        d = deviations[:, i, None] - deviations[:, i + 1 :]
        errors[i, i + 1 :] = spread = np.sqrt(np.mean(d * d, axis=0))
        ratios = np.abs(d[:, spread > 0]) / spread[spread > 0]
        largest = np.maximum(largest, ratios.max(axis=1, initial=0))
    return errors, largest
