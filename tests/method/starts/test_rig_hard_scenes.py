from functools import cache

import cv2
import numpy as np
import pytest
from toy_world import GAIN, RATE_HZ, ToyWorld, few_views

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.starts.base import Start
from spike4dgs.method.starts.plane_sweep import inverse_depth_step
from spike4dgs.method.starts.rig import middle_camera, rig

STATIC = ToyWorld(width=96, height=60, n_ticks=200, travel=0.0, views=(0, 2, 5, 7))
MOVING = ToyWorld(width=96, height=60, n_ticks=240, travel=0.5)  # 18 px; what it hides takes all views
SMALL = ToyWorld(width=40, height=24, n_ticks=30)


@cache
def start(world: ToyWorld) -> Start:
    return rig(world.training)


def distance(world: ToyWorld, points: np.ndarray, *times: float) -> tuple[np.ndarray, np.ndarray]:
    """Distance in m of points [N, 3] to floor or wall, and to the board where it is at any of `times`."""
    x, y, z = points.astype(np.float64).T
    offsets = [world.travel * (t - 0.5) for t in times]
    outside = [
        np.stack([np.maximum(np.abs(x - p) - 0.45, 0), y, np.maximum(np.abs(z - 0.6) - 0.35, 0)]) for p in offsets
    ]
    return np.minimum(np.abs(z), np.abs(y - 1.0)), np.min([np.linalg.norm(o, axis=0) for o in outside], axis=0)


def gray_scene(cameras: tuple[Camera, ...], seed: int, n_ticks: int = 24) -> TrainingScene:
    """Nothing but gray 0.5: only the phases of the pixels differ, and views agree by chance at best."""
    rng, streams = np.random.default_rng(seed), []
    for c in cameras:
        phase = rng.random((c.height, c.width))
        fired = np.diff(np.floor(phase + 0.5 * GAIN * np.arange(n_ticks + 1)[:, None, None]), axis=0) > 0
        streams.append(SpikeStream(pack(fired), c.width, c.height, RATE_HZ))
    return TrainingScene("gray", "gray", cameras, tuple(streams), RATE_HZ, n_ticks, GAIN)


def test_points_of_a_still_scene_lie_on_its_planes() -> None:
    points = start(STATIC).points
    planes, board = distance(STATIC, points, 0.5)
    off = np.minimum(planes, board)
    # One px of parallax of the widest pair is 0.08 m at the board and 0.14 m at the wall.
    assert np.median(off) < 0.04 and np.quantile(off, 0.9) < 0.2
    assert (board < 0.1).mean() > 0.1 and (np.abs(points[:, 1] - 1) < 0.1).mean() > 0.1  # both are there


def test_values_are_the_radiance_of_what_points_lie_on() -> None:
    camera, s = STATIC.held_out, start(STATIC)
    image, depth, _ = STATIC.trace(camera, 0.5)
    uv, z = camera.project(s.points.astype(np.float64))
    inside = (uv >= 0).all(axis=1) & (uv < [96, 60]).all(axis=1)
    u, v = uv[inside].astype(int).T
    on_it = np.abs(1 / z[inside] - 1 / depth[v, u]) < 0.7 * inverse_depth_step(STATIC.training.cameras)
    assert on_it.mean() > 0.6
    assert np.median(np.abs(s.values[inside] - image[v, u])[on_it]) < 0.06


@pytest.mark.parametrize("index", [0, 4, 8])
def test_every_view_is_covered(index: int) -> None:
    uv, _ = STATIC.cameras[index].project(start(STATIC).points.astype(np.float64))
    grid = np.stack(np.meshgrid(np.arange(2, 96, 4), np.arange(2, 60, 4)), -1).reshape(-1, 2)
    gap = np.linalg.norm(uv[None] - grid[:, None], axis=-1).min(axis=1)
    assert (gap < 4).mean() > 0.9


def test_what_moves_is_found_where_the_fit_begins_and_not_smeared() -> None:
    planes, board = distance(MOVING, start(MOVING).points, 0.5)
    assert ((board < 0.06) & (planes > 0.15)).mean() > 0.08
    off = np.minimum(*distance(MOVING, start(MOVING).points, 0.0, 0.5, 1.0))
    assert np.median(off) < 0.04 and np.quantile(off, 0.85) < 0.2


@pytest.mark.parametrize("t", [0.0, 1.0])
def test_background_that_the_middle_of_the_clip_hides_is_found_at_its_ends(t: float) -> None:
    camera, points = MOVING.held_out, start(MOVING).points
    u, v = np.clip(camera.project(points.astype(np.float64))[0], 0, [95, 59]).astype(int).T
    now = cv2.dilate(MOVING.trace(camera, t)[2].astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    shown = MOVING.trace(camera, 0.5)[2] & ~now
    on_wall = shown[v, u] & (np.abs(points[:, 1] - 1) < 0.2)
    assert shown.sum() > 100
    assert on_wall.sum() > 0.35 * shown.sum()  # about 0.5; 0.2 to 0.25 without the clip's ends


@pytest.mark.parametrize("seed", range(2))
def test_points_by_chance_are_not_taken_for_a_scene(seed: int) -> None:
    s = rig(gray_scene(SMALL.training.cameras[:4], seed))
    z = middle_camera(s.cameras).project(s.points.astype(np.float64))[1]
    np.testing.assert_allclose(z, 1 / inverse_depth_step(s.cameras), rtol=1e-4)  # all where nothing is known
    assert len(s.points) >= 100 and np.median(s.values) == pytest.approx(0.5, abs=0.1)


def test_two_cameras_match() -> None:
    """Each has one other view to agree with: points lie on the surfaces, not all on one plane."""
    s = rig(few_views(STATIC.training, 0, 1))
    surface, board = distance(STATIC, s.points, 0.5)
    assert (np.minimum(surface, board) < 0.1).mean() > 0.3


@pytest.mark.parametrize("chosen", [(0,), (0, 0, 0)])
def test_cameras_at_one_position_are_a_user_error(chosen: tuple[int, ...]) -> None:
    scene = gray_scene(tuple(SMALL.cameras[i] for i in chosen), 0)
    with pytest.raises(UserError, match=f"scene gray: expected training cameras apart .* found {len(chosen)} at one"):
        rig(scene)
