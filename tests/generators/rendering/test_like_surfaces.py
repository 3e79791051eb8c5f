"""Smoothing over like surfaces, against a plain loop in float64."""

from __future__ import annotations

import numpy as np
import pytest

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.rendering.like_surfaces import (
    FARTHEST,
    LEAST_EXPONENT,
    LIKE_COSINE,
    LIKE_PX,
    RADIUS_PX,
    Surfaces,
    coverage,
    pixel_widths,
    places_in,
    shared,
)

SHAPE = (2, 9, 12)


def smoothed(pixels, values, labels, points, normals, widths, sigma):
    """Return the means in the pixels' own views alone."""
    nowhere = np.full((len(pixels), len(labels), 2), np.nan, np.float32)
    surfaces = Surfaces(labels, points, normals, widths)
    return shared(pixels, values, np.ones(labels.shape, np.int32), surfaces, nowhere, sigma)


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
            exponent = -((y - row) ** 2 + (x - column) ** 2) / (2 * sigma**2)
            if (like and exponent >= LEAST_EXPONENT) or (y, x) == (row, column):
                w = np.exp(exponent)
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


def a_rig() -> tuple[Camera, ...]:
    """Two views of the plane z = 2 from a short distance apart, one of them tilted."""
    tilt = np.array([[np.cos(0.2), 0, np.sin(0.2)], [0, 1, 0], [-np.sin(0.2), 0, np.cos(0.2)]])
    lens = {"width": 12, "height": 9, "fx": 20.0, "fy": 20.0, "cx": 6.0, "cy": 4.5}
    return (
        Camera(id="a", R=np.eye(3), t=np.zeros(3), **lens),
        Camera(id="b", R=tilt, t=np.array([-0.3, 0.02, 0.0]), **lens),
    )


def plain_shared(k, values, paths, labels, points, normals, widths, cameras, sigma):
    """Return the mean and the number of views of one pixel, with every pixel of every view looked at."""
    own, row, column = np.unravel_index(k, labels.shape)
    point, wide = points[own, row, column].astype(np.float64), widths[own, row, column]
    total, weight, views = np.zeros(values.shape[-1]), 0.0, 1
    for view, camera in enumerate(cameras):
        ((u, v),), _ = camera.project(point[None])
        u, v = (column, row) if view == own else (u - 0.5, v - 0.5)
        for y in range(labels.shape[1]):
            for x in range(labels.shape[2]):
                itself = (view, y, x) == (own, row, column)
                apart = points[view, y, x] - point
                like = normals[own, row, column] @ normals[view, y, x] >= LIKE_COSINE
                like &= abs(normals[own, row, column] @ apart) <= LIKE_PX * wide
                like &= labels[view, y, x] == labels[own, row, column] and paths[view, y, x] > 0
                nearest = view != own and abs(x - u) <= 0.5 and abs(y - v) <= 0.5
                views += bool(nearest and like and np.linalg.norm(apart) <= wide)
                exponent = -((y - v) ** 2 + (x - u) ** 2) / (2 * sigma**2)
                if max(abs(y - v), abs(x - u)) > RADIUS_PX or exponent < LEAST_EXPONENT:
                    continue
                if itself or like and (view == own or np.linalg.norm(apart) <= FARTHEST * wide):
                    w = np.exp(exponent) * paths[view, y, x]
                    total, weight = total + w * values[view, y, x], weight + w
    return total / weight, views


@pytest.mark.parametrize("sigma", [0.5, 0.9])
def test_light_is_shared_by_the_views_that_see_a_point(sigma):
    rng = np.random.default_rng(1)
    cameras = a_rig()
    rows, columns = np.mgrid[:9, :12] + 0.5
    uv = np.stack([columns.ravel(), rows.ravel()], 1)
    points = np.zeros((*SHAPE, 3), np.float32)
    for view, camera in enumerate(cameras):  # where the rays meet the plane
        ways = camera.unproject(uv, np.ones(len(uv))) - camera.center
        points[view] = (camera.center + ways * ((2 - camera.center[2]) / ways[:, 2:])).reshape(9, 12, 3)
    points[..., 2] += rng.choice([0, 0.5], SHAPE, p=[0.8, 0.2])  # another plane behind
    normals = np.zeros_like(points)
    normals[..., 2] = -1
    normals[rng.random(SHAPE) < 0.1] = 0
    labels, paths = rng.integers(0, 2, SHAPE).astype(np.int8), rng.choice([4, 8, 16], SHAPE).astype(np.int32)
    paths[1, rng.random(SHAPE[1:]) < 0.1] = 0
    values, widths = rng.random((*SHAPE, 3), dtype=np.float32), pixel_widths(points, cameras)
    chosen = np.flatnonzero(paths.ravel())
    surfaces, places = Surfaces(labels, points, normals, widths), places_in(points.reshape(-1, 3)[chosen], cameras)
    views = coverage(chosen, paths, surfaces, places)
    means = shared(chosen, values, paths, surfaces, places, sigma)
    expected = [plain_shared(k, values, paths, labels, points, normals, widths, cameras, sigma) for k in chosen]
    assert 0.1 < np.mean(views == 2) < 0.9
    assert np.array_equal(views, [e[1] for e in expected])
    np.testing.assert_allclose(means, [e[0] for e in expected], rtol=1e-5)
