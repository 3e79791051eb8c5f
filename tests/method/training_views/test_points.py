"""The torch projection of points against the cameras' own."""

from __future__ import annotations

import numpy as np
import torch
from toy_world import ToyWorld

from spike4dgs.method.splat import Views
from spike4dgs.method.training_views.points import project

WORLD = ToyWorld(width=64, height=40)


def test_pixels_are_those_of_the_cameras() -> None:
    points = np.random.default_rng(0).normal(0, 2, (400, 3))
    pixels, inside = project(torch.from_numpy(points), Views.from_cameras(WORLD.cameras))
    assert inside.any() and not inside.all()
    for camera, pixel, seen in zip(WORLD.cameras, pixels.numpy(), inside.numpy(), strict=True):
        uv, z = camera.project(points)
        expected = (z > 0) & (uv >= 0).all(1) & (uv < [camera.width, camera.height]).all(1)
        u, v = uv[expected].astype(int).T
        assert np.array_equal(seen, expected)
        assert np.array_equal(pixel[seen], v * camera.width + u) and not pixel[~seen].any()


def test_the_wider_dtype_counts() -> None:
    """1 mm at 1e4 m is less than float32 resolves."""
    away, views = torch.tensor([7e3, -5e3, 6e3], dtype=torch.float64), Views.from_cameras(WORLD.cameras)
    w2c = views.w2c.clone()
    w2c[:, :3, 3] -= w2c[:, :3, :3] @ away
    points = torch.from_numpy(np.random.default_rng(1).normal(0, 0.3, (200, 3)))
    far = project(points + away, Views(w2c, views.K, views.width, views.height))
    assert all(torch.equal(a, b) for a, b in zip(far, project(points, views), strict=True))
