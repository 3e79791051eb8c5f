"""The reduced normal equations against dense least squares with every unknown written out."""

from __future__ import annotations

import numpy as np
import pytest

from spike4dgs.method.self_calibration.normal_equations import Prior, reduce


@pytest.mark.parametrize("seed", range(3))
def test_eliminated_unknowns_change_nothing(seed: int) -> None:
    P, K, C, Q, M = 4, 3, 5, 2, 3
    rng = np.random.default_rng(seed)
    value, h = rng.normal(size=(P, K, C)), rng.normal(size=(P, K, C, M))
    a, weight = rng.normal(size=(P, K, C, Q)), rng.random((P, K, C)) * (rng.random((P, K, C)) < 0.9)
    prior, now = np.array([0.3, 0.1, 0.2]), rng.normal(size=(P, M))
    found = reduce(value, h, a, weight, Prior(prior, prior * now))
    numbers, surfaces = np.linalg.solve(found.H + np.eye(C * Q), -found.g), None
    surfaces = found.surface_steps(numbers)

    rows, right = [], []
    for p, k, c in np.ndindex(P, K, C):
        row = np.zeros(C * Q + P * M + P * K)
        row[c * Q : (c + 1) * Q] = a[p, k, c]
        row[C * Q + p * M : C * Q + (p + 1) * M] = h[p, k, c]
        row[C * Q + P * M + p * K + k] = -1
        rows.append(np.sqrt(weight[p, k, c]) * row)
        right.append(-np.sqrt(weight[p, k, c]) * value[p, k, c])
    for p, m in np.ndindex(P, M):
        row = np.zeros(C * Q + P * M + P * K)
        row[C * Q + p * M + m] = np.sqrt(prior[m])
        rows.append(row)
        right.append(-np.sqrt(prior[m]) * now[p, m])
    for q in range(C * Q):
        rows.append(np.eye(C * Q + P * M + P * K)[q])
        right.append(0.0)
    dense = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    np.testing.assert_allclose(numbers, dense[: C * Q], atol=1e-9)
    np.testing.assert_allclose(surfaces.ravel(), dense[C * Q : C * Q + P * M], atol=1e-9)


def test_no_patch_tells_nothing() -> None:
    """An array that sees nothing has no patches: the equations are zeros of the usual shapes."""
    C, Q, M = 5, 2, 3
    empty = np.zeros((0, 3, C))
    found = reduce(empty, np.zeros((0, 3, C, M)), np.zeros((0, 3, C, Q)), empty, Prior(np.ones(M), np.zeros((0, M))))
    np.testing.assert_array_equal(found.H, np.zeros((C * Q, C * Q)))
    np.testing.assert_array_equal(found.g, np.zeros(C * Q))
    assert found.surface_steps(np.zeros(C * Q)).shape == (0, M)
