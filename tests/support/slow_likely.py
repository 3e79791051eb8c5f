"""The slow twin of `likely_spikes`: all ticks of a train as one normal variable, its covariance written out."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.spikes.likely_spikes import CERTAIN, CHANGES, CONTEXT, NEAR_TICKS, TICK, TIE, UNKNOWN


def slow_likely(
    before: Sequence[int], after: Sequence[int], lost: Sequence[int]
) -> tuple[list[int], list[int], float] | None:
    """Return the likely ticks, those of `lost` that are certain, and how near the nearest choice was to another one.

    `before` and `after` are a pixel's spikes on either side, the nearest first. None where nothing tells.
    """
    left, right = _context(before)[::-1], _context(after)
    if len(left) + len(right) == 2:
        return None
    trains = [c for n in range(len(lost) + 1) for c in itertools.combinations(lost, n)]
    trains.sort(key=lambda train: sum(1 << lost.index(t) for t in train))
    scores = np.array([_log_likelihoods(left, train, right) for train in trains])
    shares = np.exp(scores - scores.max()).sum(axis=1)
    shares /= shares.sum()
    best = trains[next(i for i, s in enumerate(shares) if s >= shares.max() * (1 - TIE))]
    wrong = [sum(s for s, c in zip(shares, trains, strict=True) if (t in c) != (t in best)) for t in lost]
    others = [s for s, c in zip(shares, trains, strict=True) if c != best]
    near = min([abs(w / CERTAIN - 1) for w in wrong] + [1 - max(others) / shares.max()])
    return list(best), [t for t, w in zip(lost, wrong, strict=True) if w < CERTAIN], near


def _context(spikes: Sequence[int]) -> list[int]:
    kept = list(spikes[: CONTEXT + 1])
    return kept + [
        t for t, u in zip(spikes[CONTEXT + 1 :], spikes[CONTEXT:], strict=False) if abs(u - spikes[0]) < NEAR_TICKS
    ]


def _log_likelihoods(left: Sequence[int], train: Sequence[int], right: Sequence[int]) -> NDArray[np.float64]:
    """Return the log likelihood of all ticks for each of CHANGES, but for a constant.

    It holds whatever the first instant and interval are.
    """
    change = np.array(CHANGES)[:, None]
    ticks = np.array([*left, *train, *right], float)
    steps, n = np.diff(ticks), len(ticks)
    widest = math.log(right[0] - left[-1])
    # The log intervals are `mean`, and `walk` times independent deviates: a first one, and one from each to the next.
    walk = change[..., None] * np.tril(np.ones((n - 1, n - 1)))
    known = len(left) > 1
    walk[..., 0] = 0.0 if known else np.sqrt(UNKNOWN + change**2)
    mean = np.zeros(n - 1) if known else np.full(n - 1, widest)
    gathered = np.tril(np.ones((n, n - 1)), -1) * steps  # instants from log intervals
    expected = gathered @ (1 - np.log(steps) + mean)
    spread, noise = gathered @ walk, np.full((len(change), n), TICK)
    seen, free = ticks, np.ones((n, 2 if known else 1))
    if known:
        free[:, 1] = gathered.sum(axis=1)
    if len(right) == 1:  # the interval after the last spike is about the widest
        seen, expected = np.append(seen, widest), np.append(expected, mean[-1])
        spread = np.concatenate([spread, walk[:, -1:]], axis=1)
        noise = np.concatenate([noise, UNKNOWN + change**2], axis=1)
        free = np.vstack([free, [0.0, 1.0][: free.shape[1]]])
    covariance = spread @ spread.transpose(0, 2, 1) + noise[..., None] * np.eye(len(seen))
    inverse = np.linalg.inv(covariance)
    rest = (seen - expected)[:, None]
    information = free.T @ inverse @ free
    rest = rest - free @ np.linalg.solve(information, free.T @ inverse @ rest)
    squares = (rest.transpose(0, 2, 1) @ inverse @ rest)[:, 0, 0]
    logs = np.linalg.slogdet(covariance)[1] + np.linalg.slogdet(information)[1]
    return np.asarray(-(squares + logs + (len(seen) - free.shape[1]) * math.log(2 * math.pi)) / 2)
