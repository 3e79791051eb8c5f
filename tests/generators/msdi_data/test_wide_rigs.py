"""Rigs of many kinds: baselines, aims and rotations."""

from __future__ import annotations

import numpy as np

from spike4dgs.generators.msdi_data.wide_rigs import layout, wide_cameras
from spike4dgs.generators.worlds import WORLDS


def test_the_widest_pair_of_a_layout_is_one_apart() -> None:
    for seed in range(20):
        places = layout(np.random.default_rng(seed))
        distances = np.linalg.norm(places[:, None] - places[None], axis=-1)
        assert places.shape == (9, 2) and np.isclose(distances.max(), 1)


def test_rigs_have_the_baselines_that_they_should_and_see_the_target() -> None:
    world = WORLDS["turntable"].build(0, 13, 0.1)
    shares, focals = [], []
    for seed in range(60):
        rig = wide_cameras(world, 128, 96, np.random.default_rng(seed))
        centers = np.stack([camera.center for camera in rig])
        for camera in rig:
            np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(camera.R) > 0 and camera.center[2] > 0
        middle = centers.mean(axis=0)
        away = np.linalg.norm(middle - np.array(world.rig.target))
        widest = np.linalg.norm(centers[:, None] - centers[None], axis=-1).max()
        shares.append(widest / away)
        focals.append(rig[0].fx)
        # All axes pass within a picture's width of a common point, so that the views overlap.
        aims = np.stack([camera.R[2] for camera in rig])
        common = middle + away * aims.mean(axis=0) / np.linalg.norm(aims.mean(axis=0))
        uv = np.concatenate([camera.project(common[None])[0] for camera in rig])
        assert np.abs(uv - (64, 48)).max() < 128
    assert 0.015 < min(shares) < 0.05 and 0.2 < max(shares) < 0.5
    assert max(focals) > 2.5 * min(focals)


def test_without_an_amount_they_stand_where_the_worlds_own_do() -> None:
    world = WORLDS["car"].build(0, 13, 0.1)
    rig = wide_cameras(world, 128, 96, np.random.default_rng(0), 0.0)
    middle = np.mean([camera.center for camera in rig], axis=0)
    away = np.linalg.norm(np.array(world.rig.center) - np.array(world.rig.target))
    assert np.linalg.norm(middle - np.array(world.rig.center)) < 0.1 * away
