"""Shadings against known ones: cameras before a textured plane, some of it hidden, some of it moving."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from toy_world import ToyWorld

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.array_path import ArrayPath
from spike4dgs.method.self_calibration.shading import shadings, with_shadings
from spike4dgs.method.starts.base import Start

WIDTH, HEIGHT, DEPTH = 96, 64, 5.0
Pattern = Callable[[np.ndarray, np.ndarray], np.ndarray]  # of places from 0 to 1
PATTERNS: tuple[Pattern, ...] = (
    lambda x, y: 0.1 * (x - 0.5) - 0.1 * (y - 0.5) ** 2,
    lambda x, y: 0.15 * (x - 0.5) * (y - 0.5) + 0.3 * (x - 0.5) ** 3,
    lambda x, y: -0.2 * (y - 0.5) ** 2 + 0.05 * (x - 0.5),
    lambda x, y: 0.1 * np.cos(3 * x) * np.cos(2 * y),  # no polynomial
)


def cameras(distortion: tuple[float, ...] = ()) -> tuple[Camera, ...]:
    centers = [(x, y, 0.0) for y in (-0.1, 0.1) for x in (-0.1, 0.1)]  # wider arrays confuse more with textures
    made = [
        Camera(f"cam_{k}", WIDTH, HEIGHT, 80.0, 80.0, WIDTH / 2, HEIGHT / 2, np.eye(3), -np.array(c))
        for k, c in enumerate(centers)
    ]
    return tuple(replace(c, distortion=distortion) for c in made)


def texture(points: np.ndarray) -> np.ndarray:
    """Logarithms of radiance on the plane."""
    x, y = points[:, 0], points[:, 1]
    return np.asarray(-2 + 0.5 * np.sin(2 * x) * np.cos(3 * y) + 0.2 * np.sin(9 * x + 4 * y))


def seen(array: tuple[Camera, ...], patterns: tuple[Pattern, ...], rng: np.random.Generator) -> list[np.ndarray]:
    """Logarithms of what each camera sees of the plane, with noise of single pixels."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    logs = []
    for camera, pattern in zip(array, patterns, strict=True):
        light = texture(camera.unproject(uv, np.full(len(uv), DEPTH))).reshape(HEIGHT, WIDTH)
        logs.append(light + np.log1p(pattern(u / WIDTH, v / HEIGHT)) + 0.01 * rng.standard_normal(u.shape))
    return logs


def points_of(rng: np.random.Generator, count: int = 4000) -> np.ndarray:
    return np.column_stack([rng.uniform(-3, 3, count), rng.uniform(-2, 2, count), np.full(count, DEPTH)])


def expected(patterns: tuple[Pattern, ...]) -> np.ndarray:
    """The patterns [C, H, W], less what all have in common, with mean 1."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    logs = np.stack([np.log1p(p(u / WIDTH, v / HEIGHT)) for p in patterns])
    maps = np.exp(logs - logs.mean(axis=0))
    return np.asarray(maps / maps.mean(axis=(1, 2), keepdims=True))


@pytest.mark.parametrize("distortion", [(), (-0.1, 0.02, 0.0, 0.0, 0.0)])
def test_known_shadings_are_found_but_for_what_all_cameras_share(distortion: tuple[float, ...]) -> None:
    rng, array = np.random.default_rng(0), cameras(distortion)
    found = shadings(array, seen(array, PATTERNS, rng), points_of(rng))
    assert found is not None and found.dtype == np.float32
    np.testing.assert_allclose(found.mean(axis=(1, 2)), 1, rtol=1e-5)
    true = expected(PATTERNS)
    assert true.std(axis=(1, 2)).max() > 0.02
    assert (found - true).std() < 0.1 * true.std()


def test_cameras_of_other_sensitivity_have_the_same_shadings() -> None:
    rng, array = np.random.default_rng(0), cameras()
    logs, points = seen(array, PATTERNS, rng), points_of(rng)
    found = shadings(array, logs, points)
    other = shadings(array, [log + 0.5 * k for k, log in enumerate(logs)], points)
    assert found is not None and other is not None
    np.testing.assert_allclose(other, found, atol=3e-3)


def test_a_part_that_one_camera_sees_otherwise_hardly_counts() -> None:
    rng, array = np.random.default_rng(0), cameras()
    logs, points = seen(array, PATTERNS, rng), points_of(rng)
    clean = shadings(array, logs, points)
    logs[1][20:40, 30:55] += 1.0  # something before the plane
    found = shadings(array, logs, points)
    assert clean is not None and found is not None
    assert np.abs(found - clean).max() < 0.02


def test_cameras_without_shadings_have_none() -> None:
    rng, array = np.random.default_rng(0), cameras()
    even: tuple[Pattern, ...] = (lambda x, y: 0 * x,) * 4
    assert shadings(array, seen(array, even, rng), points_of(rng)) is None


def test_few_points_tell_nothing() -> None:
    rng, array = np.random.default_rng(0), cameras()
    assert shadings(array, seen(array, PATTERNS, rng), points_of(rng, 300)) is None


def test_a_scene_that_tells_nothing_stays_itself(capsys: pytest.CaptureFixture[str]) -> None:
    scene = ToyWorld(width=32, height=20, side=2, n_ticks=120).training
    points = np.random.default_rng(0).uniform(-1, 1, (900, 3)).astype(np.float32)
    still = Start(scene.cameras, points[:100], np.zeros(100, np.float32))
    assert with_shadings(scene, still) is scene
    path = ArrayPath(np.zeros((2, 6)), np.zeros(3), 0.5)
    assert with_shadings(scene, Start(scene.cameras, points, np.zeros(900, np.float32), path)) is scene
    assert not capsys.readouterr().err
