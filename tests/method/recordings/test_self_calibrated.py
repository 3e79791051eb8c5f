"""Poses and clocks of a recording before a fit: left alone where they are right, or where the clip tells nothing."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from clock_world import ClockWorld
from lit_streams import lit
from scipy.spatial.transform import Rotation
from toy_world import GAIN, few_views

from spike4dgs.baselines.images.tfp import TFP
from spike4dgs.benchmark.scene.camera_state import CameraState, Clock
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.images.training import ImageSettings, make_training_images
from spike4dgs.method.recordings.held_out import held_out_views
from spike4dgs.method.recordings.recording import GIVEN, Recording
from spike4dgs.method.recordings.self_calibrated import self_calibrated, survey_clocks
from spike4dgs.method.self_calibration.clock_fit import ClockSettings
from spike4dgs.method.self_calibration.clock_search import SearchSettings

FEW = ClockSettings(times=3, moving_patches=10, static_patches=8)
SHORT = ClockWorld(width=120, height=76, n_ticks=96, travel=0.1, views=(0, 2, 5, 7)).training


def recording(scene: TrainingScene) -> Recording:
    return Recording(scene, "all", GIVEN, ())


def test_a_short_clip_with_right_poses_is_left_alone() -> None:
    found = self_calibrated(recording(SHORT), "auto", "auto", seed=0)
    assert found.recording.training is SHORT and found.changed == ()
    poses, clocks = found.recording.notes
    assert poses.startswith("poses: taken as given") and "they need 3 cameras and 124 ticks; this clip has" in clocks
    assert all(float(px) < 0.3 for px in found.columns["pose error, px"].values())


def test_what_is_given_is_not_looked_at() -> None:
    found = self_calibrated(recording(SHORT), "given", "given", seed=0)
    assert found.recording.training is SHORT and found.recording.notes == () and not found.columns


def test_wrong_poses_are_adjusted_and_said() -> None:
    rng, given = np.random.default_rng(0), []
    for camera in SHORT.cameras:
        R = Rotation.from_rotvec(np.radians(0.5) * rng.normal(size=3)).as_matrix() @ camera.R
        given.append(replace(camera, R=R, t=-R @ camera.center))
    found = self_calibrated(recording(replace(SHORT, cameras=tuple(given))), "auto", "given", seed=0)
    assert found.changed == ("poses",) and found.given == tuple(given)
    assert "the given ones are wrong" in found.recording.notes[0]
    assert found.recording.training.cameras != tuple(given)


def test_clocks_that_differ_are_used() -> None:
    ticks = {"cam_00": 6.0, "cam_05": -9.0, "cam_07": 12.0}
    world = ClockWorld(clocks={c: Clock(t) for c, t in ticks.items()}, views=(0, 4, 6, 7))
    few = ClockSettings(times=5, moving_patches=25, static_patches=8)
    scene, notes, columns = survey_clocks(world.training, few, SearchSettings(times=3, patches=10, most_ticks=60))
    mean = sum(ticks.values()) / 4
    for camera in world.training.cameras:
        told = scene.state(camera.id).clock.local(120) - 120
        assert told == pytest.approx(ticks.get(camera.id, 0.0) - mean, abs=0.3)
        assert columns["clock, ticks"][camera.id].startswith(f"{told:+.2f} ")
    assert "estimated from what moves, and used" in notes[0]


def test_where_nothing_moves_clocks_are_left_alone() -> None:
    still = ClockWorld(n_ticks=130, travel=0.0, views=(0, 2, 5, 7)).training
    scene, notes, _ = survey_clocks(still, FEW, SearchSettings(times=2, patches=5, most_ticks=20))
    assert scene is still and "too little moves to tell them" in notes[0]


def test_where_light_changes_clocks_are_left_alone() -> None:
    """A period of flicker late is like on time: of still scenes the search made clocks that are whole periods off."""
    world = ClockWorld(n_ticks=130, travel=0.0)
    flicker, rng = 1 + 0.2 * np.cos(2 * np.pi * np.arange(130) / 40), np.random.default_rng(0)
    streams = {c.id: lit(flicker, GAIN * world.trace(c, 0.0)[0], rng) for c in world.cameras}
    lamp = replace(world.training, streams=tuple(streams[c.id] for c in world.training.cameras))
    scene, notes, _ = survey_clocks(lamp, FEW, SearchSettings(times=2, patches=5, most_ticks=20))
    assert scene is lamp and notes == ("clocks: taken as given, because the light changes",)
    name, one = world.held_out.id, few_views(lamp, 0)  # tells no clocks
    folder: Any = SimpleNamespace(
        cameras={name: world.held_out}, test=(name,), stream=streams.__getitem__, recordings=lambda _: None
    )
    assert held_out_views(folder, one, ["clocks"], 0)[name].clock == Clock()


def test_images_are_made_at_each_cameras_own_tick() -> None:
    name = SHORT.cameras[1].id
    scene = replace(SHORT, states={name: CameraState(clock=Clock(20.3))})
    settings = ImageSettings(time_spacing_ticks=20)
    made = make_training_images(scene, scene.cameras, TFP, settings, "cpu")
    plain = make_training_images(SHORT, SHORT.cameras, TFP, settings, "cpu")
    assert (made.images[:, 0] == plain.images[:, 0]).all() and made.ticks == plain.ticks
    for i, tick in enumerate(made.ticks):
        image = made.measured(i)[1].numpy()
        if tick + 20 < 96:
            np.testing.assert_array_equal(image, TFP(SHORT.streams[1], [tick + 20], SHORT.radiance_gain)[0])
        else:
            assert np.isnan(image).all()
