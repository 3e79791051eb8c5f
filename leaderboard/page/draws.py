"""The random numbers of the bootstrap: a hash of a counter, so that the page's JavaScript draws the same ones.

The hash is lowbias32 of C. Wellons' hash-prospector, a bijection of 32 bits.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from spike4dgs.benchmark.arrays import Float64, UInt32


def hashed(counters: UInt32, seed: int) -> UInt32:
    """Return 32 random bits for each counter: lowbias32(counter ^ lowbias32(seed))."""
    return _lowbias32(counters ^ _lowbias32(np.array(seed, np.uint32)))


def _lowbias32(x: UInt32) -> UInt32:
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

    Args:
        images: The number of images of each scene.
        seeds: The number of seeds.
        most_seeds: The largest number of seeds of any method: with it, methods share the draws of scenes and images.
        replicates: The number of resampled means.
        scenes: Draw scenes too; otherwise each counts once.
        seed: Of the draws.
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
