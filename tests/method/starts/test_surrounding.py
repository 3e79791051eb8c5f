"""First points for cameras around their subject."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_scenes import array_cameras

from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.benchmark.scene.scene import TrainingScene, open_scene
from spike4dgs.generators.held_frames.footage import find_footage
from spike4dgs.generators.held_frames.scene import Holding, write_held_frames
from spike4dgs.method.starts.base import Start
from spike4dgs.method.starts.msdi import msdi
from spike4dgs.method.starts.rig import rig
from spike4dgs.method.starts.surrounding import looked_at, points_inside

CENTER = np.array([1.0, -2.0, 0.5])
UP = np.array([0.0, 0.0, 1.0])


def ring(n: int = 6, degrees: float = 240.0, distance: float = 0.12, outwards: bool = False) -> tuple[Camera, ...]:
    cameras = []
    for i, angle in enumerate(np.radians(np.linspace(0, degrees, n))):
        away = distance * np.array([np.cos(angle), np.sin(angle), 0.1])
        target = CENTER + (2 * away if outwards else 0)
        size = {"focal": 400.0, "width": 48, "height": 32}
        cameras.append(look_at(f"cam_{i:02d}", CENTER + away, target, UP, **size))
    return tuple(cameras)


def test_the_axes_of_a_ring_meet_in_its_subject() -> None:
    ball = looked_at(ring())
    assert ball is not None
    np.testing.assert_allclose(ball.center, CENTER, atol=1e-9)
    distance = 0.12 * np.hypot(1, 0.1)
    assert ball.radius == pytest.approx(distance * np.hypot(24, 16) / 400)


def test_arrays_that_face_their_scene_and_cameras_that_look_outwards_have_none() -> None:
    assert looked_at(array_cameras(4)) is None
    assert looked_at(ring(degrees=50)) is None
    assert looked_at(ring(outwards=True)) is None


def test_points_lie_in_the_ball_and_in_two_images_and_are_the_same_again() -> None:
    cameras = ring()
    ball = looked_at(cameras)
    assert ball is not None
    points = points_inside(ball, cameras)
    radii = np.linalg.norm(points - ball.center, axis=1) / ball.radius
    assert radii.max() <= 1 and len(points) > 300
    views = sum(
        ((uv >= 0).all(1) & (uv < (c.width, c.height)).all(1) & (z > 0)).astype(int)
        for c in cameras
        for uv, z in [c.project(points)]
    )
    assert np.min(views) >= 2
    np.testing.assert_array_equal(points, points_inside(ball, cameras))


@pytest.mark.parametrize("first", [rig, msdi])
def test_the_start_of_a_ring_has_points_where_its_cameras_look_with_what_they_see(
    first: Callable[[TrainingScene], Start], tmp_path: Path
) -> None:
    cameras = ring()
    for c in cameras:
        (tmp_path / "footage" / c.id).mkdir(parents=True)
        Image.new("L", (c.width, c.height), 128).save(tmp_path / "footage" / c.id / "0.png")
    holding = Holding(held_out="cam_02", hold_ticks=200, linear=True)
    write_held_frames(tmp_path / "scene", find_footage(tmp_path / "footage"), cameras, holding)
    scene = open_scene(tmp_path / "scene").training
    start = first(scene)
    assert np.abs(np.median(start.points, axis=0) - CENTER).max() < 0.002  # the cameras are 0.12 away
    assert np.median(start.values) == pytest.approx(128 / 255, abs=0.03)
    assert [c.id for c in start.cameras] == [c.id for c in scene.cameras]
