"""Patches of an array's views, and images of windows."""

from dataclasses import replace

import numpy as np
from clock_world import ClockWorld

from spike4dgs.benchmark.scene.camera_state import CameraState
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.method.self_calibration.patches import (
    BASIS,
    POINTS,
    STRIDE_PX,
    Patches,
    blurred,
    look_up,
    moment,
    rays,
    strongest,
    sweep,
    viewers,
    window_image,
)

WORLD = ClockWorld(n_ticks=120)
SCENE = WORLD.training


def test_an_image_is_the_mean_rate_and_a_moment_lies_between_two() -> None:
    viewer, stream = viewers(SCENE)[0], SCENE.streams[0]
    np.testing.assert_allclose(window_image(viewer, 50, 10, 0), stream.window(40, 60).mean(0) / 0.6, rtol=1e-6)
    found = moment(viewer, 50.25, 10, 0.0)
    a, b = (window_image(viewer, t, 10, 0.0) for t in (50, 51))
    np.testing.assert_allclose(found.image, 0.75 * a + 0.25 * b)
    np.testing.assert_allclose(found.by_x[5, 5], (found.image[5, 6] - found.image[5, 4]) / 2)
    assert window_image(viewer, 9, 10, 0) is None and window_image(viewer, 111, 10, 0) is None


def test_gaps_and_bad_pixels_say_nothing() -> None:
    name, stream = SCENE.cameras[0].id, SCENE.streams[0]
    bad = np.zeros((WORLD.height, WORLD.width), bool)
    bad[10:13, 20:23] = True
    streams = (replace(stream, gaps=(Gap(name, 30, 2, "lost"),)), *SCENE.streams[1:])
    scene = replace(SCENE, streams=streams, states={name: CameraState(gain=1.1, bad=bad)})
    viewer = viewers(scene)[0]
    assert window_image(viewer, 20, 10, 0) is not None and window_image(viewer, 42, 10, 0) is not None
    assert window_image(viewer, 41, 10, 0) is None and window_image(viewer, 21, 10, 0) is None
    image = window_image(viewer, 60, 10, 0)
    assert np.isnan(image[bad]).all() and np.isfinite(image[~bad]).all()
    np.testing.assert_allclose(image[~bad], (stream.window(50, 70).mean(0) / 0.66)[~bad], rtol=1e-6)


def test_a_blur_leaves_out_what_is_no_number() -> None:
    image = np.full((20, 20), 3.0)
    image[5, 5] = np.nan
    np.testing.assert_allclose(blurred(image, 1.0), 3.0)
    image[10:18, 10:18] = np.nan
    assert np.isnan(blurred(image, 1.0)[14, 14])


CAMERAS = WORLD.training.cameras


def test_points_are_seen_where_the_cameras_project_them() -> None:
    patches = Patches(np.array([2]), np.array([[40.0, 30.0]]), np.array([[0.3, 0.004, -0.002]]))
    uv, slope = rays(CAMERAS, patches, CAMERAS[5]).project(patches.inverse)
    pixels = patches.center + BASIS[:, 1:]
    points = CAMERAS[2].unproject(pixels, 1 / (0.3 + pixels @ [0.004, -0.002] - patches.center @ [0.004, -0.002])[:])
    np.testing.assert_allclose(uv[0], CAMERAS[5].project(points)[0], atol=1e-9)
    later, _ = rays(CAMERAS, patches, CAMERAS[5]).project(patches.inverse + 1e-6)
    np.testing.assert_allclose(slope, (later - uv) / 1e-6, rtol=1e-4)
    assert len(pixels) == POINTS and np.ptp(pixels[:, 0]) == 2 * STRIDE_PX


def test_the_sweep_finds_the_depth_of_the_world() -> None:
    seen = viewers(WORLD.training)
    moments = [moment(v, 60.0, 20, 0.7) for v in seen]
    centers = strongest(np.hypot(moments[0].by_x, moments[0].by_y), 0.0, 6, 60)
    patches = Patches(np.zeros(len(centers), int), centers, np.zeros((len(centers), 3)))
    inverse, _ = sweep(CAMERAS, moments, patches, np.linspace(0.15, 0.5, 60))
    x, y = centers.astype(int).T
    true = 1 / WORLD.trace(CAMERAS[0], 0.5)[1][y, x]
    assert np.median(np.abs(inverse / true - 1)) < 0.02


def test_the_strongest_pixels_are_one_a_cell_and_above_the_limit() -> None:
    score = np.random.default_rng(0).random((40, 60))
    score[20, 30], score[12, 12] = 5.0, np.nan
    found = strongest(score, 0.9, 10, 8)
    assert tuple(found[0]) == (30.5, 20.5) and len(found) == 8
    x, y = found.astype(int).T
    assert (score[y, x] > 0.9).all() and len({(a // 10, b // 10) for a, b in zip(x, y, strict=True)}) == 8
    assert len(strongest(np.zeros((40, 60)), 0.5, 10, 8)) == 0


def test_values_between_pixels_are_bilinear_and_none_outside() -> None:
    y, x = np.mgrid[:10, :12] + 0.5
    image = 2 * x - 3 * y + 1
    uv = np.array([[3.2, 4.9], [10.7, 8.1], [-1.0, 3.0], [11.9, 3.0]])
    np.testing.assert_allclose(look_up(image, uv), [*(uv[:2] @ [2, -3] + 1), np.nan, np.nan])
