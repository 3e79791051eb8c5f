"""Reflections in planar mirrors and panes: traced where they move, against Mitsuba's own loop."""

from __future__ import annotations

import numpy as np
import pytest
from built_worlds import built

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.make_dataset import SceneSettings, make_dataset
from spike4dgs.generators.rendering.image_motion import imaged, max_image_speed, mirrored
from spike4dgs.generators.rendering.render import MultiViewRenderer
from spike4dgs.generators.rig import cameras

T_S = 0.0113


@pytest.fixture(scope="module")
def r() -> MultiViewRenderer:
    world = built("mirror", 1)
    return MultiViewRenderer(world, cameras(world, 64, 40, (4,)), seed=0, spp=32, background_spp=128)


def test_moving_reflections_are_rendered_as_by_mitsubas_own_loop(r):
    key, truth, traced = r.keys(T_S), r.reference_frames(T_S, 256), r.traced(T_S)
    reflected = r.moving_masks(T_S) & ~r.object_masks(T_S)
    assert 0.005 < reflected.mean() < 0.1 and traced[reflected].all()
    assert np.array_equal(key[reflected], r.crn_frames(T_S)[reflected])
    still = np.abs(r.background - truth)
    assert np.abs(key - truth)[reflected].mean() < 0.25 * still[reflected].mean()
    assert abs((key - truth)[traced].mean()) < 0.004
    assert still[~traced].max() < 0.06  # nothing else changes: no reflection is missed, in the pane neither
    panes = [s for s, flagged, _ in r._snapshot(T_S).reflections if s.in_glass and flagged.any()]
    assert panes and any(len(s.planes) == 1 for s in panes)


def test_images_in_mirrors_move_as_the_mirrored_object(r):
    world, (camera,) = r.world, r.cameras
    pose, later = (world.poses(t)["block"] for t in (T_S, T_S + 1e-5))
    corners = world.groups["block"][0].mesh.vertices
    plane = max(world.mirrors, key=lambda p: abs(p[1]))  # the mirror faces the cameras more than the pane does
    places = [camera.project(mirrored(corners @ p[:3, :3].T + p[:3, 3], plane))[0] for p in (pose, later)]
    fastest = np.linalg.norm(places[1] - places[0], axis=1).max() / 1e-5
    speed = r.speeds(T_S)[r.moving_masks(T_S) & ~r.object_masks(T_S)].max()
    assert 0.7 * fastest < speed < 1.05 * fastest
    assert fastest < 1.02 * max_image_speed(world, r.cameras, 0.02)
    np.testing.assert_allclose(imaged(corners, [plane, plane]), corners, atol=1e-12)


def test_split_light_refuses_mirrors(tmp_path):
    job = SceneSettings("tiny", rendering="split").job("mirror")
    with pytest.raises(UserError, match="--rendering split: expected a world without mirrors"):
        make_dataset([job], tmp_path)
    assert not list(tmp_path.iterdir())
