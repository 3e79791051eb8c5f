"""What a clip tells of its cameras before a fit: right poses stay as they are, those a little off are mended."""

from dataclasses import replace

import numpy as np
import pytest
from clock_world import ClockWorld
from scipy.spatial.transform import Rotation
from toy_world import few_views
from warm_cameras import warm_scene

from spike4dgs.generators.physics import Physics, given_cameras
from spike4dgs.method.self_calibration.from_clip import as_in_clip, at_mended_poses

WORLD = ClockWorld(width=192, height=122, n_ticks=96, travel=0.1, views=(0, 2, 5, 7))  # six pairs, of 28


def turns_px(cameras) -> float:
    """RMS distance by which the cameras' turns move pixels, less the turn that all have in common."""
    turns = np.stack(
        [Rotation.from_matrix(c.R.T @ t.R).as_rotvec() for c, t in zip(cameras, WORLD.training.cameras, strict=True)]
    )
    turns -= turns.mean(axis=0)
    return float(np.sqrt(np.mean(turns[:, :2] ** 2)) * WORLD.training.cameras[0].fx)


def test_right_poses_stay_and_poses_a_little_off_are_mended(capsys: pytest.CaptureFixture[str]) -> None:
    assert as_in_clip(WORLD.training, 0, poses=True) is WORLD.training
    given = given_cameras(WORLD.training.cameras, "none", Physics(pose_noise_deg=0.0375), [2])
    off = replace(WORLD.training, cameras=given)
    found = as_in_clip(off, 0, poses=True).cameras
    assert turns_px(found) < 0.5 * turns_px(given)
    assert "the given poses are off" in capsys.readouterr().err
    assert as_in_clip(off, 0, poses=False) is off


def test_other_dark_rates_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    warm = warm_scene((1.0, 2.0))
    assert as_in_clip(warm, 0, poses=False).state("cam_01").dark == pytest.approx(2, abs=0.15)
    assert "1 of 2 cameras have " in capsys.readouterr().err


def test_a_clip_that_shows_too_little_changes_nothing() -> None:
    given = given_cameras(WORLD.training.cameras, "none", Physics(pose_noise_deg=0.0375), [0])
    off = replace(WORLD.training, cameras=given)
    one = few_views(off, 0)
    black = replace(off, streams=tuple(replace(s, packed=np.zeros_like(s.packed)) for s in off.streams))
    for scene in (one, black):
        assert at_mended_poses(scene, 0) is scene
