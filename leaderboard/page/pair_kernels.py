"""What rank intervals need of every pair of many methods, in compiled loops that stay in the cache.

A thousand methods are half a million pairs of two thousand draws each. The results are those of the loops in
`intervals.pair_statistics`: sums go over the draws in their order, as in NumPy but for the last pair.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.compilation import cached_njit
from spike4dgs.benchmark.environment import available_cores

WIDTH = 32  # methods of a tile: 2000 draws of them are half a MB
_CLOSE = 1 - 1e-12  # products that stand for quotients may be a last bit off


# Without the two flags, maxima are taken one at a time. There is no NaN: draws are finite.
@cached_njit(nogil=True, fastmath={"nnan", "nsz"})
def _tile(d: Float64, tile: Float64, first: int, errors: Float64, largest: Float64) -> None:
    """Add the pairs of each method and a tile [R, WIDTH] of later ones, which begins at `first`. d: [M, R]."""
    draws = tile.shape[0]
    last = min(first + WIDTH, d.shape[0])
    spread, wide = np.empty(WIDTH), np.empty(WIDTH)
    for i in range(last - 1):
        spread[:] = 0
        for r in range(draws):
            x = d[i, r]
            for j in range(WIDTH):
                difference = x - tile[r, j]
                spread[j] += difference * difference
        for j in range(WIDTH):
            spread[j] = math.sqrt(spread[j] / draws)
            later = i < first + j < d.shape[0]
            if later:
                errors[i, first + j] = spread[j]
            if not later or spread[j] == 0:
                spread[j] = math.inf
            wide[j] = spread[j] * _CLOSE
        for r in range(draws):
            x, most = d[i, r], largest[r]
            beyond = 0
            for j in range(WIDTH):
                beyond += abs(x - tile[r, j]) > most * wide[j]
            if beyond:
                for j in range(WIDTH):
                    most = max(most, abs(x - tile[r, j]) / spread[j])
                largest[r] = most


def pair_statistics(deviations: Float64) -> tuple[Float64, Float64]:
    """Return what `intervals.pair_statistics` returns."""
    draws, n = deviations.shape
    by_method, errors = np.ascontiguousarray(deviations.T), np.zeros((n, n))
    run: Callable[..., Any] = _tile

    def largest_from(first: int) -> Float64:
        there, tile, largest = min(WIDTH, n - first), np.zeros((draws, WIDTH)), np.zeros(draws)
        tile[:, :there] = deviations[:, first : first + there]
        run(by_method, tile, first, errors, largest)
        return largest

    with ThreadPoolExecutor(available_cores(), "pairs") as pool:
        return errors, np.max(list(pool.map(largest_from, range(0, n, WIDTH))), axis=0)
