"""Smoothing over like surfaces, against a plain loop in float64."""

from __future__ import annotations

import numpy as np
import pytest

from spike4dgs.generators.rendering.like_surfaces import LIKE_COSINE, LIKE_PX, RADIUS_PX, smoothed

SHAPE = (2, 9, 12)


def plain(k, values, labels, points, normals, widths, sigma):
    view, row, column = np.unravel_index(k, labels.shape)
    total, weight = np.zeros(values.shape[-1]), 0.0
    for y in range(labels.shape[1]):
        for x in range(labels.shape[2]):
            if max(abs(y - row), abs(x - column)) > RADIUS_PX or labels[view, y, x] != labels[view, row, column]:
                continue
            normal = normals[view, row, column].astype(np.float64)
            off = normal @ (points[view, y, x].astype(np.float64) - points[view, row, column])
            like = normal @ normals[view, y, x] >= LIKE_COSINE and abs(off) <= LIKE_PX * widths[view, row, column]
            if like or (y, x) == (row, column):
                w = np.exp(-((y - row) ** 2 + (x - column) ** 2) / (2 * sigma**2))
                total, weight = total + w * values[view, y, x], weight + w
    return total / weight


@pytest.mark.parametrize("sigma", [0.3, 0.8, 2.0])
def test_smoothing_is_the_mean_over_like_surfaces(sigma):
    rng = np.random.default_rng(0)
    tilts = rng.choice([0.0, 0.3, 1.2], SHAPE)  # like, like enough, another surface
    normals = np.stack([np.sin(tilts), np.zeros(SHAPE), np.cos(tilts)], -1).astype(np.float32)
    normals[rng.random(SHAPE) < 0.1] = 0  # no surface
    points = rng.normal(0, 0.02, (*SHAPE, 3)).astype(np.float32)
    values = rng.random((*SHAPE, 6), dtype=np.float32)
    labels, widths = rng.integers(0, 2, SHAPE).astype(np.int8), np.full(SHAPE, 0.03, np.float32)
    chosen = rng.permutation(int(np.prod(SHAPE)))[:60]
    found = smoothed(chosen, values, labels, points, normals, widths, sigma)
    expected = [plain(k, values, labels, points, normals, widths, sigma) for k in chosen]
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_a_step_between_two_walls_stays():
    normals = np.zeros((*SHAPE, 3), np.float32)
    normals[:, :, :6, 0] = normals[:, :, 6:, 1] = 1
    values = (np.arange(12) >= 6)[None, None, :, None] * np.ones((*SHAPE, 6), np.float32)
    points, widths, labels = np.zeros((*SHAPE, 3), np.float32), np.ones(SHAPE, np.float32), np.zeros(SHAPE, np.int8)
    found = smoothed(np.arange(labels.size), values, labels, points, normals, widths, 1.5)
    assert np.array_equal(found.reshape(values.shape), values)
