"""Windows of a camera's ticks as images, with gaps and pixels that say nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from clock_world import ClockWorld

from spike4dgs.benchmark.scene.camera_state import CameraState
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.method.self_calibration.patches import blurred, moment, viewers, window_image

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
