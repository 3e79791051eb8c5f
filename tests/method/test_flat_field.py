"""Images and first points corrected by the cameras' calibrations: what a perfect sensor would have given."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scenes import array_cameras

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.generators.sensor.calibration import dark_map, gain_map
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate
from spike4dgs.method.images.training import ImageSettings, make_training_images
from spike4dgs.method.starts.msdi import infer
from spike4dgs.method.starts.rig import RigSettings, rig
from spike4dgs.method.supervision.spike_cameras import SpikeCameras

GAIN, TICKS = 0.6, 200
ADAPTIVE = IMAGES["adaptive"]


def light(camera):
    return np.tile(np.linspace(0.2, 0.8, camera.width, dtype=np.float32), (camera.height, 1))


def record(camera, sensor, light, n_ticks, seed):
    keys = [np.broadcast_to(np.float32(light), (camera.height, camera.width))] * 2
    packed = np.concatenate(list(simulate(keys, [0, n_ticks], n_ticks, sensor, random_charge(*keys[0].shape, [seed]))))
    return SpikeStream(packed, camera.width, camera.height, 2e4, True, dead_ticks=sensor.dead_ticks)


@pytest.fixture(scope="module")
def scene() -> TrainingScene:
    return uneven_scene()


def uneven_scene(dead_ticks: float = 0.0, light=light, n_ticks: int = TICKS, alive=1) -> TrainingScene:
    """Cameras of uneven pixels in front of a soft gradient of light, or of another one; dead where not `alive`."""
    cameras, streams, recordings = array_cameras(), [], []
    for i, camera in enumerate(cameras):
        pixels = camera.height, camera.width, 0, camera.id
        sensor = Sensor(GAIN, 1.1 * alive * gain_map(*pixels), 4 * alive * dark_map(*pixels), dead_ticks=dead_ticks)
        streams.append(record(camera, sensor, light(camera), n_ticks, i))
        flat, dark = record(camera, sensor, 0.7, 500, i), record(camera, sensor, 0.0, 2000, i)
        recordings.append(Recordings(flat, dark, 0.7))
    return TrainingScene("uneven", "uneven", tuple(cameras), tuple(streams), 2e4, n_ticks, GAIN, tuple(recordings))


def error(scene, **settings):
    made = make_training_images(scene, scene.cameras, ADAPTIVE, ImageSettings(**settings), "cpu")
    truth = np.stack([light(c) for c in scene.cameras])
    return float(np.sqrt(np.mean((made.images.numpy() - truth) ** 2)))


def test_images_lose_the_pattern_of_the_pixels(scene):
    assert error(scene) > 0.04
    assert error(scene, flat_field=True) < 0.008


def test_a_dead_pixel_has_the_values_of_a_neighbour_and_is_no_measurement(scene):
    """Optical flow and all that blurs would spread a value that is no number; a loss leaves the pixel out."""
    dead = np.zeros((scene.cameras[0].height, scene.cameras[0].width), bool)
    dead[[0, 9, 9], [3, 20, 21]] = True
    uneven, settings = uneven_scene(alive=~dead), ImageSettings(flat_field=True)
    made = make_training_images(uneven, uneven.cameras, ADAPTIVE, settings, "cpu")
    images = made.images.numpy()
    assert np.isfinite(images).all() and (made.bad.numpy() == dead).all()
    for y, x in np.argwhere(dead):
        around = [p for p in ((y, x - 1), (y, x + 1), (y - 1, x), (y + 1, x)) if not dead[p]]
        assert all(any((own[:, y, x] == own[:, *p]).all() for p in around) for own in images.swapaxes(0, 1))
    assert (made.measured(3).isfinite().numpy() == ~dead).all()
    assert make_training_images(scene, scene.cameras, ADAPTIVE, settings, "cpu").bad is None


def test_without_recordings_images_stay_as_they_are(scene):
    bare = replace(scene, recordings=())
    assert error(bare, flat_field=True) == error(bare)


def test_first_points_take_the_corrected_gray(scene):
    """The gradient is one surface at no definite depth: what counts is that no point is brighter than the light."""
    plain, flat = rig(scene).values, rig(scene, RigSettings(flat_field=True)).values
    assert plain.max() > 0.85 and flat.max() < 0.82
    np.testing.assert_array_equal(rig(replace(scene, recordings=()), RigSettings(flat_field=True)).values, plain)


def test_dead_ticks_bend_the_response_and_are_known():
    """A pixel that rests for a tick after each spike fires at x / (1 + x): 0.3 in place of 0.43 spikes a tick."""
    scene = uneven_scene(dead_ticks=1.0)
    unknown = replace(scene, streams=tuple(replace(s, dead_ticks=0.0) for s in scene.streams))
    assert error(scene, flat_field=True) < 0.012 and error(unknown, flat_field=True) > 0.1
    assert rig(scene, RigSettings(flat_field=True)).values.max() < 0.83
    cameras = SpikeCameras(scene)
    truth = torch.from_numpy(np.stack([light(c) for c in scene.cameras]))
    seen = np.stack([s.counts(0, TICKS) / TICKS for s in scene.streams])
    expected = cameras.rate(truth, tuple(range(len(scene.cameras)))).numpy()
    assert np.abs(expected - seen).mean() < 0.004 and expected.max() < 0.4


def test_a_network_sees_the_charge_behind_dead_ticks():
    """The maps of a sensor are of the charge: taken from the spikes as they are, half of the pattern stays."""
    scene, image = uneven_scene(1.0, lambda _: np.float32(0.8), 400), ImageSettings(max_times=1, flat_field=True)
    scene = replace(scene, cameras=scene.cameras[:1], streams=scene.streams[:1], recordings=scene.recordings[:1])
    found = make_training_images(scene, scene.cameras, IMAGES["msdi"], image, "cpu").images.numpy()
    assert np.sqrt(np.mean((found - 0.8) ** 2)) < 0.003
    assert infer(scene, device="cpu", calibrated=True).images.mean() == pytest.approx(0.8, rel=0.02)
