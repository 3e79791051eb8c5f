"""A small classifier on features of windows, scored where it was not trained: logistic regression and its AUC."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import rankdata

from spike4dgs.benchmark.arrays import Float64, Int64

FOLDS = 5
_RIDGE = 10.0  # weight of the squared coefficients; features have standard deviation 1
_FAR = 4.0  # standard deviations at which features are cut


def auc(first: Float64, second: Float64) -> float:
    """Return the probability that a value of `second` is above one of `first`, ties half: the area under the ROC curve.

    >>> auc(np.array([1.0, 2.0]), np.array([2.0, 3.0]))
    0.875
    """
    ranks = rankdata(np.concatenate([first, second]))[len(first) :]
    n = len(second)
    return float((ranks.sum() - n * (n + 1) / 2) / (len(first) * n))


def out_of_fold(first: Float64, second: Float64, folds: Int64) -> tuple[Float64, Float64]:
    """Return scores of the rows of two classes of features [N, F], each by a classifier that saw other folds alone.

    `folds` [N]: row i of both classes is in fold folds[i]. Features enter with their squares, as a spread may differ
    where a mean does not.
    """
    scores = np.zeros(len(first)), np.zeros(len(second))
    for fold in np.unique(folds):
        other, own = folds != fold, folds == fold
        seen = np.concatenate([first[other], second[other]])
        middle, scale = seen.mean(0), seen.std(0) + 1e-12

        def design(rows: Float64, middle: Float64 = middle, scale: Float64 = scale) -> Float64:
            z = np.clip((rows - middle) / scale, -_FAR, _FAR)
            return np.hstack([z, z * z - 1, np.ones((len(z), 1))])

        weights = _fit(design(seen), np.repeat([0.0, 1.0], other.sum()))
        for score, rows in zip(scores, (first, second), strict=True):
            score[own] = design(rows[own]) @ weights
    return scores


def _fit(design: Float64, is_second: Float64) -> Float64:
    """Return the coefficients [F] of ridge logistic regression; the last, of the constant, is free."""
    ridge = np.full(design.shape[1], _RIDGE)
    ridge[-1] = 0

    def loss(weights: Float64) -> tuple[float, Float64]:
        z = design @ weights
        value = np.logaddexp(0, z).sum() - is_second @ z + ridge @ weights**2 / 2
        return float(value), design.T @ (expit(z) - is_second) + ridge * weights

    return np.asarray(minimize(loss, np.zeros(design.shape[1]), jac=True, method="L-BFGS-B").x)


def auc_interval(
    scores: tuple[Float64, Float64], groups: Int64, rng: np.random.Generator, repeats: int = 300
) -> tuple[float, float, float]:
    """Return the AUC of scores and its 95 % interval, by a bootstrap over groups [N] of dependent rows."""
    members = [np.flatnonzero(groups == g) for g in np.unique(groups)]
    drawn = []
    for _ in range(repeats):
        rows = np.concatenate([members[i] for i in rng.integers(len(members), size=len(members))])
        drawn.append(auc(scores[0][rows], scores[1][rows]))
    low, high = np.percentile(drawn, (2.5, 97.5))
    return auc(*scores), float(low), float(high)


def single_aucs(names: tuple[str, ...], first: Float64, second: Float64) -> Mapping[str, float]:
    """Return the AUC of each feature alone, the farthest from 1/2 first."""
    found = {name: auc(a, b) for name, a, b in zip(names, first.T, second.T, strict=True)}
    return dict(sorted(found.items(), key=lambda item: -abs(item[1] - 0.5)))


def tiles(corners: NDArray[np.integer], side: int) -> Int64:
    """Return the number of the square tile that each corner (y, x) [N, 2] lies in: windows of one are one group."""
    y, x = (corners // side).T
    return np.asarray(y * (int(x.max(initial=0)) + 1) + x, np.int64)
