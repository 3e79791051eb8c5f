"""Images and first points corrected by the cameras' calibrations: what a perfect sensor would have given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_scenes import array_cameras

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.generators.sensor.calibration import dark_map, gain_map
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate
from spike4dgs.method.images.training import ImageSettings, make_training_images
from spike4dgs.method.starts.rig import RigSettings, rig

GAIN, TICKS = 0.6, 200


def record(camera, sensor, light, n_ticks, seed):
    keys = [np.broadcast_to(np.float32(light), (camera.height, camera.width))] * 2
    packed = np.concatenate(list(simulate(keys, [0, n_ticks], n_ticks, sensor, random_charge(*keys[0].shape, [seed]))))
    return SpikeStream(packed, camera.width, camera.height, 2e4, True)


@pytest.fixture(scope="module")
def scene() -> TrainingScene:
    """Cameras of uneven pixels in front of a soft gradient of light."""
    cameras, streams, recordings = array_cameras(), [], []
    for i, camera in enumerate(cameras):
        pixels = camera.height, camera.width, 0, camera.id
        sensor = Sensor(GAIN, 1.1 * gain_map(*pixels), 4 * dark_map(*pixels))
        streams.append(record(camera, sensor, light(camera), TICKS, i))
        flat, dark = record(camera, sensor, 0.7, 500, i), record(camera, sensor, 0.0, 2000, i)
        recordings.append(Recordings(flat, dark, 0.7))
    return TrainingScene("uneven", "uneven", tuple(cameras), tuple(streams), 2e4, TICKS, GAIN, tuple(recordings))


def light(camera):
    return np.tile(np.linspace(0.2, 0.8, camera.width, dtype=np.float32), (camera.height, 1))


def error(scene, **settings):
    images = make_training_images(
        scene, scene.cameras, IMAGES["adaptive"], ImageSettings(**settings), "cpu"
    ).images.numpy()
    truth = np.stack([light(c) for c in scene.cameras])
    return float(np.sqrt(np.mean((images - truth) ** 2)))


def test_images_lose_the_pattern_of_the_pixels(scene):
    assert error(scene) > 0.04
    assert error(scene, flat_field=True) < 0.008


def test_without_recordings_images_stay_as_they_are(scene):
    bare = replace(scene, recordings=())
    assert error(bare, flat_field=True) == error(bare)


def test_first_points_take_the_corrected_gray(scene):
    """The gradient is one surface at no definite depth: what counts is that no point is brighter than the light."""
    plain, flat = rig(scene).values, rig(scene, RigSettings(flat_field=True)).values
    assert plain.max() > 0.85 and flat.max() < 0.82
    np.testing.assert_array_equal(rig(replace(scene, recordings=()), RigSettings(flat_field=True)).values, plain)
