"""Training-only worlds: their motions against the laws that they follow."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from spike4dgs.generators.msdi_data.clutter import TRAINING_WORLDS, texture
from spike4dgs.generators.worlds import WORLDS, WorldScene

STEP_S = 1e-3


def poses(world: WorldScene, t_s: float) -> np.ndarray:
    return np.stack(list(world.poses(t_s).values()))


@lru_cache
def build(name: str, variant: int = 13) -> WorldScene:
    return TRAINING_WORLDS[name].build(0, variant, 0.1)


every_world = pytest.mark.parametrize("name", sorted(TRAINING_WORLDS))


def test_they_are_not_the_benchmarks() -> None:
    assert not set(TRAINING_WORLDS) & set(WORLDS)


@every_world
def test_bodies_are_rigid_and_fall_as_they_should(name: str) -> None:
    before, now, after = (poses(build(name), 0.05 + k * STEP_S) for k in (-1, 0, 1))
    turns = now[:, :3, :3]
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turns.shape), atol=1e-12)
    acceleration = (before - 2 * now + after)[:, :3, 3] / STEP_S**2
    expected = (0, 0, -9.81) if name == "tumble" else (0, 0, 0)
    np.testing.assert_allclose(acceleration, np.broadcast_to(expected, acceleration.shape), atol=1e-6)
    spins = [b[:, :3, :3] @ a[:, :3, :3].transpose(0, 2, 1) for a, b in ((before, now), (now, after))]
    np.testing.assert_allclose(*spins, atol=1e-9)  # constant
    moved = np.linalg.norm((after - before)[:, :3, 3], axis=1)
    assert (moved == 0).all() if name == "whirl" else (moved > 0).all()


@every_world
def test_a_variant_is_a_function_of_its_number(name: str) -> None:
    worlds = build(name), build.__wrapped__(name), build(name, 14)
    first, same, other = (world.moving_points(0.03) for world in worlds)
    np.testing.assert_array_equal(same, first)
    assert other.shape != first.shape or not np.allclose(other, first)


def test_textures_are_reflectances_that_differ() -> None:
    images = [texture(64, np.random.default_rng(seed)) for seed in range(20)]
    assert all(image.shape == (64, 64, 3) and np.isfinite(image).all() and image.min() >= 0 for image in images)
    assert len({float(image.mean()) for image in images}) == 20
