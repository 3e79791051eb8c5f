"""People run and ride as real ones do; `test_worlds.py` tells that wheels roll."""

from __future__ import annotations

import numpy as np
import pytest
from built_worlds import built

from spike4dgs.generators.worlds import jaywalk
from spike4dgs.generators.worlds.meshes import box
from spike4dgs.generators.worlds.parts import cycles, figure
from spike4dgs.generators.worlds.parts.rigid_bodies import owners


def test_a_foot_on_the_ground_rests_and_legs_keep_their_length():
    run = {"speed_m_s": 5.0, "strides_per_s": 1.5, "phase": 0.0, "lane_y_m": 0.0}
    stance = [jaywalk.stride(**run, t_s=t).ankles["left"] for t in np.linspace(0, 0.24 / 1.5, 9)]
    np.testing.assert_allclose(np.diff(stance, axis=0), 0, atol=1e-9)
    for t in np.linspace(0, 0.7, 29):
        joints = jaywalk.stride(**run, t_s=t)
        before, after = jaywalk.stride(**run, t_s=t - 1e-5), jaywalk.stride(**run, t_s=t + 1e-5)
        poses = figure.poses(joints)
        for side in figure.SIDES:
            assert joints.ankles[side][2] >= figure.ANKLE_M - 1e-9
            assert np.linalg.norm(after.ankles[side] - before.ankles[side]) / 2e-5 < 20  # no jumps
            knee, ankle = poses[f"{side}_shin"][:3, 3], poses[f"{side}_shoe"][:3, 3]
            assert np.linalg.norm(knee - poses[f"{side}_thigh"][:3, 3]) == pytest.approx(figure.THIGH_M, abs=1e-6)
            assert np.linalg.norm(ankle - knee) == pytest.approx(figure.SHIN_M, abs=1e-6)
            hip = poses[f"{side}_thigh"][:3, 3]
            ahead = knee[0] - (hip[0] + ankle[0]) / 2
            assert ahead > -1e-3  # knees bend forward


def test_reach_meets_a_goal_or_stretches_towards_it():
    rng = np.random.default_rng(0)
    for _ in range(200):
        start, goal, bend = rng.normal(size=(3, 3))
        middle, end = figure.reach(start, goal, 0.4, 0.3, bend)
        assert np.linalg.norm(middle - start) == pytest.approx(0.4, abs=1e-9)
        assert np.linalg.norm(end - middle) == pytest.approx(0.3, abs=1e-9)
        distance = np.linalg.norm(goal - start)
        if 0.11 < distance < 0.69:
            np.testing.assert_allclose(end, goal, atol=1e-9)
        np.testing.assert_allclose(np.cross(end - start, goal - start), 0, atol=1e-9)


def test_feet_stay_on_the_pedals():
    world = built("bicycle")
    gaps = []
    for t in np.linspace(-0.24, 0.26, 40):
        poses = world.poses(t)
        for side in figure.SIDES:
            gaps.append(poses[f"rider_{side}_shoe"][:3, 3] - poses[f"{side}_pedal"][:3, 3])
    assert np.ptp(np.array(gaps)[::2], axis=0).max() < 0.01


def test_a_rider_sits_on_a_moving_cycle_as_on_a_resting_one():
    feet = {"left": (-0.1, 0.1, 0.3), "right": (-0.1, -0.1, 0.3)}
    points = ((-0.2, 0, 0.95), (0.1, 0, 1.3), (0.4, 0.2, 0.95), feet, 0.0)
    resting, moved = cycles.seated(np.eye(4), *points), np.eye(4)
    moved[:3, 3] = 3.0, 1.0, 0.0
    for name, pose in cycles.seated(moved, *points).items():
        np.testing.assert_allclose(pose, moved @ resting[name], atol=1e-12)


def test_owners_number_bodies():
    meshes = [box((1, 1, 1), (0, 0, 0))] * 2
    vertex, face = owners(meshes)
    assert (np.bincount(vertex) == len(meshes[0].vertices)).all() and (np.bincount(face) == len(meshes[0].faces)).all()
