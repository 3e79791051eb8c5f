"""Calibration from flat-field and dark recordings: the estimates are the camera's true maps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from changes import leave_part
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import array_cameras, write_small_scene

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import locked
from spike4dgs.benchmark.runs.apart.training_part import write_training_part
from spike4dgs.benchmark.scene.calibration import Recordings, estimate, rates
from spike4dgs.benchmark.scene.cameras import look_at
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.benchmark.spikes.stream import SpikeStream, open_stream, pack
from spike4dgs.cli.calibrate import calibrate
from spike4dgs.generators.sensor import calibration as calibration
from spike4dgs.generators.sensor.calibration import dark_map, gain_map, write_maps
from spike4dgs.generators.sensor.model import Sensor

WIDTH, HEIGHT = 200, 125


def recordings(folder, sensor):
    up = np.array([0.0, 0.0, 1.0])
    camera = look_at("cam_00", np.array([0, -3.0, 1]), np.zeros(3), up, focal=200, width=WIDTH, height=HEIGHT)
    calibration.write_calibration(folder, camera, sensor, [1, 2])
    flat, dark = (open_stream(folder / name / "cam_00.dat", WIDTH, HEIGHT, 2e4) for name in ("flat", "dark"))
    return Recordings(flat, dark, calibration.calibration_facts(sensor.radiance_gain)["flat_radiance"])


def real_sensor(pixels):
    """Return a sensor with maps and shot noise."""
    photons = SENSOR.photons_per_spike
    return Sensor(gain=gain_map(*pixels), dark=dark_map(*pixels), photons=photons, noise_seed=(3,))


def rms(found, truth):
    return float(np.sqrt(np.mean((found / truth - 1) ** 2)))


def test_maps_are_recovered_from_a_scenes_recordings(tmp_path):
    pixels = HEIGHT, WIDTH, 0, "cam_00"
    sensor = real_sensor(pixels)
    made = recordings(tmp_path, sensor)
    flat, dark = made.flat, made.dark
    assert (flat.n_ticks, dark.n_ticks) == (calibration.FLAT_TICKS, calibration.DARK_TICKS)
    found = estimate(made)
    assert rms(found.gain, sensor.gain) < 0.003  # required: 0.01
    assert rms(found.dark, sensor.dark) < 0.05  # required: 0.20
    assert found.radiance_gain == pytest.approx(0.6, rel=1e-3)
    counted = flat.counts(0, flat.n_ticks) / flat.n_ticks - dark.counts(0, dark.n_ticks) / dark.n_ticks
    assert rms(found.gain, sensor.gain) < 0.5 * rms(counted / counted.mean(), sensor.gain)  # better than counting


@pytest.mark.parametrize(("light", "radiance"), [(0.25, 0.7), (2, 0.7), (4, 0.35), (16, 0.0875)])
def test_maps_are_recovered_whatever_light_reaches_the_sensor(tmp_path, light, radiance):
    """Under radiance 0.7, four times the light makes every pixel fire in every tick: no map, and a gain of 1.42."""
    sensor = replace(real_sensor((HEIGHT, WIDTH, 0, "cam_00")), radiance_gain=0.6 * light)
    made = recordings(tmp_path, sensor)
    assert made.flat_radiance == pytest.approx(radiance)
    found = estimate(made)
    assert rms(found.gain, sensor.gain) < 0.01 and found.radiance_gain == pytest.approx(0.6 * light, rel=2e-3)


@pytest.mark.parametrize(("share", "refused"), [(0.04, False), (0.08, True)])
def test_a_recording_of_saturated_pixels_is_refused(share, refused):
    rng = np.random.default_rng(0)
    spikes, none = rng.random((60, 8, 25)) < 0.5, np.zeros((60, 8, 25))
    spikes[:, rng.permutation(200).reshape(8, 25) < 200 * share] = True
    made = Recordings(*(SpikeStream(pack(found), 25, 8, 2e4) for found in (spikes, none)), 0.7)
    if refused:
        with pytest.raises(UserError, match="at most 5% saturated pixels, found 8% .* every tick; .* dimmer light"):
            estimate(made)
    else:
        assert estimate(made).gain.mean() == pytest.approx(1)


def test_an_ideal_camera_comes_out_flat_and_dark(tmp_path):
    found = estimate(recordings(tmp_path, Sensor()))
    assert np.abs(found.gain - 1).max() < 0.01
    assert found.dark.max() < 1 / calibration.DARK_TICKS


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 9), st.integers(1, 21), st.integers(1, 60), st.booleans(), st.integers(0, 2**31))
def test_rates_are_those_of_the_unpacked_spikes(height, width, n, bottom_up, seed):
    rng = np.random.default_rng(seed)
    spikes = rng.random((n, height, width)) < rng.random((height, width))
    stream = SpikeStream(pack(spikes, bottom_up), width, height, 2e4, bottom_up)
    expected = np.zeros((height, width))
    for y, x in np.ndindex(height, width):
        t = np.flatnonzero(spikes[:, y, x])
        expected[y, x] = (len(t) - 1) / (t[-1] - t[0]) if len(t) > 1 else (1 if len(t) else 0.5) / n
    np.testing.assert_allclose(rates(stream), expected)


def test_recordings_that_do_not_fit_are_refused():
    dark = SpikeStream(pack(np.zeros((40, 8, 16))), 16, 8, 2e4)
    other = SpikeStream(pack(np.zeros((40, 8, 24))), 24, 8, 2e4)
    with pytest.raises(UserError, match="one size"):
        estimate(Recordings(other, dark, 0.7))
    with pytest.raises(UserError, match="no more spikes than in the dark"):
        estimate(Recordings(dark, dark, 0.7))


def test_a_dead_pixel_has_no_gain_and_shows_as_nan():
    charge = np.random.default_rng(0).random((8, 16))
    light, dark = (
        np.diff(np.floor(np.arange(ticks + 1)[:, None, None] * rate + charge), axis=0)
        for ticks, rate in ((500, 0.42), (2000, 0.005))
    )
    light[:, 3, 4] = dark[:, 3, 4] = 0
    flat, black = (SpikeStream(pack(spikes), 16, 8, 2e4) for spikes in (light, dark))
    found = estimate(Recordings(flat, black, 0.7))
    assert np.argwhere(found.gain <= 0).tolist() == [[3, 4]] and ", 1 dead," in repr(found)
    assert found.gain.mean() == pytest.approx(1)
    image = IMAGES["tfp"](flat, [250], 0.6, found)[0]
    assert np.argwhere(np.isnan(image)).tolist() == [[3, 4]]


def scene_with_recordings(root, facts):
    for camera in array_cameras():
        pixels = camera.height, camera.width, 0, camera.id
        sensor = real_sensor(pixels)
        calibration.write_calibration(root / "calibration", camera, sensor, [1, 2])
        if camera.id != "cam_03":  # the truth of this one is unknown
            write_maps(root / f"truth/{camera.id}.npz", {"gain": sensor.gain, "dark": sensor.dark})
    return write_small_scene(root, extras={"calibration": facts})


FACTS = {key.lower(): getattr(calibration, key) for key in ("FLAT_RADIANCE", "FLAT_TICKS", "DARK_TICKS")}


def test_the_command_writes_maps_and_images_and_scores_them(tmp_path, capsys):
    scene, half = scene_with_recordings(tmp_path / "scene", FACTS), leave_part(tmp_path / "out")
    assert calibrate(scene, out=tmp_path / "out") == 0 and not half.exists()
    lines = {line.split()[1]: line.split() for line in capsys.readouterr().out.splitlines() if "cam_" in line}
    assert set(lines) == {"cam_00", "cam_01", "cam_02", "cam_03"}
    for camera, cells in lines.items():
        gain_error, dark_error = cells[9], cells[11]
        with np.load(tmp_path / f"out/{camera}.npz") as maps:
            gain, dark = maps["gain"], maps["dark"]
        assert (tmp_path / f"out/{camera}.png").stat().st_size > 10_000
        if camera == "cam_03":
            assert (gain_error, dark_error) == ("-", "-")
            continue
        with np.load(scene / f"truth/{camera}.npz") as truth:
            assert float(gain_error) == pytest.approx(100 * rms(gain, truth["gain"]), abs=0.001)
            assert float(dark_error) == pytest.approx(100 * rms(dark, truth["dark"]), abs=0.001)
        assert 0 < float(gain_error) < 1 and 0 < float(dark_error) < 20


def test_light_is_recovered_from_the_rates_of_uneven_pixels(tmp_path):
    pixels = HEIGHT, WIDTH, 0, "cam_00"
    sensor = Sensor(gain=gain_map(*pixels), dark=dark_map(*pixels))
    radiance = np.random.default_rng(0).uniform(0.05, 1, (HEIGHT, WIDTH)).astype(np.float32)
    rate = 0.6 * sensor.gain * radiance + sensor.dark
    assert np.abs(rate / 0.6 - radiance).max() > 0.1
    assert np.abs(estimate(recordings(tmp_path, sensor)).radiance(rate) - radiance).max() < 0.02


def test_methods_get_a_calibration_of_every_training_camera_or_none(tmp_path, small_scene):
    assert open_scene(small_scene).training.calibrations is None
    scene = open_scene(scene_with_recordings(tmp_path / "scene", FACTS)).training
    assert len(scene.calibrations) == len(scene.cameras)
    for camera, found in zip(scene.cameras, scene.calibrations, strict=True):
        assert rms(found.gain, gain_map(camera.height, camera.width, 0, camera.id)) < 0.01


def test_a_training_part_has_maps_of_its_training_cameras(tmp_path):
    part = write_training_part(open_scene(scene_with_recordings(tmp_path / "scene", FACTS)), tmp_path / "part")
    assert calibrate(part.root, out=tmp_path / "out") == 0
    assert sorted(p.stem for p in (tmp_path / "out").glob("*.npz")) == sorted(part.train)


def test_scenes_without_recordings_are_refused(tmp_path, small_scene):
    with pytest.raises(UserError, match="calibration recordings, found none of cam_00"):
        calibrate(small_scene, out=tmp_path / "out")
    scene = scene_with_recordings(tmp_path / "other", FACTS | {"dark_ticks": 77})
    with pytest.raises(UserError, match="77 ticks"):
        calibrate(scene, out=tmp_path / "out")


def test_two_calibrations_into_one_folder_exclude_each_other(tmp_path: Path) -> None:
    with locked(tmp_path / ".lock", "x", "free"), pytest.raises(UserError, match="found a run in progress; wait"):
        calibrate(write_small_scene(tmp_path / "scene"), out=tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [".lock", "scene"]


def test_maps_of_two_scenes_are_not_mixed(tmp_path: Path) -> None:
    write_maps(tmp_path / "maps/cam_99.npz", {"gain": np.ones((2, 2), np.float32)})
    with pytest.raises(UserError, match="expected a folder for this scene's maps, found cam_99.npz of another scene"):
        calibrate(write_small_scene(tmp_path / "scene"), out=tmp_path / "maps")
