"""The path of an array that moves, in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spike4dgs.generators.physics import Physics
from spike4dgs.generators.rig import array_path, cameras
from spike4dgs.generators.worlds import WORLDS


@pytest.fixture(scope="module")
def world():
    return WORLDS["blank"].build(0, 0, 0.02)


def path_of(world, **physics):
    return array_path(world.rig, Physics(**physics), [0, 10])


def test_an_array_that_stands_still_has_no_path(world):
    assert path_of(world) is None


def test_a_camera_sees_a_point_where_the_composed_pose_says(world):
    rig, path = cameras(world, 64, 40, (0, 4, 8)), path_of(world, array_motion=3.0, array_rotation=200.0)
    points, t_s = np.random.default_rng(0).uniform(-2, 2, (50, 3)) + world.rig.target, 0.013
    to_array = np.linalg.inv(path.to_world(t_s))
    for camera, posed in zip(rig, path.posed(rig, t_s), strict=True):
        composed = camera.w2c @ to_array
        in_camera = points @ composed[:3, :3].T + composed[:3, 3]
        expected = in_camera[:, :2] / in_camera[:, 2:] * camera.fx + (camera.cx, camera.cy)
        uv, z = posed.project(points)
        np.testing.assert_allclose(uv, expected, atol=1e-9)
        np.testing.assert_allclose(z, in_camera[:, 2], atol=1e-9)
        np.testing.assert_allclose(posed.center, path.to_world(t_s)[:3, :3] @ camera.center + path.to_world(t_s)[:3, 3])


def test_the_array_starts_where_it_stands_and_keeps_its_speeds(world):
    path, middle = path_of(world, array_motion=3.0, array_rotation=200.0), np.array(world.rig.center)
    np.testing.assert_allclose(path.to_world(0.0), np.eye(4), atol=1e-12)
    for t_s in (0.0, 0.01, 0.1):
        here, there = path.to_world(t_s), path.to_world(t_s + 1e-5)
        moved = (there[:3, :3] - here[:3, :3]) @ middle + there[:3, 3] - here[:3, 3]
        assert np.linalg.norm(moved) / 1e-5 == pytest.approx(3.0, rel=1e-6)
        turned = Rotation.from_matrix(there[:3, :3] @ here[:3, :3].T).magnitude()
        assert np.degrees(turned) / 1e-5 == pytest.approx(200.0, rel=1e-6)
    still = path_of(world, array_rotation=200.0).to_world(0.1)
    np.testing.assert_allclose(still[:3, :3] @ middle + still[:3, 3], middle, atol=1e-12)
    told = path.described([0, 20], 20_000.0)
    assert told["ticks"] == [0, 20]
    np.testing.assert_array_equal(told["array_to_world"][1], path.to_world(0.001))
