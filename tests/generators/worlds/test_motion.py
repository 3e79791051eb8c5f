"""Motion in the worlds follows the physics of its objects."""

from __future__ import annotations

import numpy as np
import pytest
from built_worlds import built

from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WORLDS, WorldScene, bicycle, bricks, jaywalk, motor
from spike4dgs.generators.worlds.parts import bird_body, cycles, figure, van_body
from spike4dgs.generators.worlds.parts.rigid_bodies import GRAVITY_M_S2, STEP_S, Body, owners, simulate

STREET = ["jaywalk", "bicycle", "motor", "car", "van"]


def is_fast(world: WorldScene) -> bool:
    """Return whether a camera of 30 images a second would smear it over a quarter of its length."""
    return world.notes["speed_m_s"] / 30 >= world.notes["length_m"] / 4


@pytest.mark.parametrize("name", sorted(set(WORLDS) - set(STREET)))
@pytest.mark.parametrize("variant", [1, 5])
def test_variants_are_fast(name, variant):
    assert is_fast(built(name, variant))


@pytest.mark.parametrize("name", STREET)
@pytest.mark.parametrize("variant", [0, 3])
def test_street_objects_cross_from_left_to_right_at_their_speed(name, variant):
    world = built(name, variant, 0.5)
    assert is_fast(world)
    middle = np.array([world.moving_points(t)[:, 0].mean() for t in np.linspace(0, 0.5, 6)])
    assert np.polyfit(np.linspace(0, 0.5, 6), middle, 1)[0] == pytest.approx(world.notes["speed_m_s"], rel=0.03)
    (camera,) = cameras(world, 400, 250, (4,))
    across = [camera.project(world.moving_points(t))[0][:, 0].mean() for t in (0.24, 0.25, 0.26)]
    assert across[0] < across[1] < across[2] and abs(across[1] - 200) < 60


@pytest.mark.parametrize("name", sorted(WORLDS))
def test_nothing_sinks_into_the_ground(name):
    world = built(name, 0, 0.1)
    assert is_fast(world)
    for t in np.linspace(0, 0.1, 7):
        assert world.moving_points(t)[:, 2].min() > (-0.03 if name in STREET else -0.004)


# ---------------------------------------------------------------- people and wheels


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


@pytest.mark.parametrize(
    ("name", "wheel", "radius"),
    [
        ("bicycle", "front_wheel", bicycle.WHEEL_M),
        ("motor", "rear_wheel", motor.WHEEL_M),
        ("van", "rim0", van_body.WHEEL_M),
    ],
)
def test_wheels_roll_without_slipping(name, wheel, radius):
    """The point of the tyre that touches the ground is at rest."""
    world = built(name, 0, 0.1)
    before, after = (world.poses(t)[wheel] for t in (0.03, 0.03 + 1e-6))
    contact = before[:3, 3] - [0, 0, radius]
    local = np.linalg.inv(before) @ np.append(contact, 1)
    assert np.linalg.norm((after @ local)[:3] - contact) / 1e-6 < 1e-3 * world.notes["speed_m_s"]


def test_feet_stay_on_the_pedals():
    world = built("bicycle", 0, 0.5)
    gaps = []
    for t in np.linspace(0, 0.5, 40):
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


# ---------------------------------------------------------------- falling and flying


def test_free_fall_is_a_parabola_and_spin_stays():
    throw = Body("box", (0.02, 0.02, 0.02), (0, 0, 1.0), velocity=(1.0, -0.5, 2.0), spin=(0, 0, 30.0))
    path = simulate([throw], 0.0, 0.2)
    for t in (0.0, 0.0501, 0.1337, 0.2):
        turn, position = path.at(t)
        expected = np.array([t, -0.5 * t, 1 + 2 * t - GRAVITY_M_S2 * t * t / 2])
        np.testing.assert_allclose(position[0], expected, atol=GRAVITY_M_S2 * 0.2 * STEP_S)  # a step of first order
        angle = np.arctan2(turn[0, 1, 0], turn[0, 0, 0])
        assert np.angle(np.exp(1j * (angle - 30 * t))) == pytest.approx(0, abs=1e-3)
        np.testing.assert_allclose(turn[0] @ turn[0].T, np.eye(3), atol=1e-12)


def test_momentum_is_kept_when_two_balls_meet():
    balls = [
        Body("sphere", (0.03,), (-0.1, 0, 1.0), velocity=(4.0, 0, 0)),
        Body("sphere", (0.03,), (0.1, 0.01, 1.0), velocity=(-2.0, 0, 0)),
    ]
    path = simulate(balls, 0.0, 0.06)
    speed = np.diff(path.positions, axis=0) / STEP_S  # equal masses
    total = speed.sum(1)
    assert abs(speed[-1, 0, 0] - speed[0, 0, 0]) > 1  # they met
    np.testing.assert_allclose(total[:, :2], np.broadcast_to(total[0, :2], total[:, :2].shape), atol=0.02)
    energy = (speed**2).sum((1, 2)) / 2 + GRAVITY_M_S2 * path.positions[1:, :, 2].sum(1)
    assert energy[-1] < energy[0] * 1.001


@pytest.mark.parametrize("name", ["bricks", "chips"])
def test_bodies_stay_rigid_and_above_the_table(name):
    world = built(name, 0, 0.1)
    (surface,) = world.deforming.values()
    count = {"bricks": bricks.ROWS * bricks.COLUMNS, "chips": 48}[name]
    assert surface.bodies.max() == count - 1
    points = len(surface.part.mesh.vertices) // count
    shapes = [surface.vertices(t).reshape(count, points, 3) for t in (0.0, 0.0333, 0.0712, 0.1)]
    first = np.linalg.norm(shapes[0][:, :, None] - shapes[0][:, None], axis=-1)
    for shape in shapes[1:]:
        np.testing.assert_allclose(np.linalg.norm(shape[:, :, None] - shape[:, None], axis=-1), first, atol=1e-9)
    assert min(s[..., 2].min() for s in shapes) > -0.003
    moved = np.linalg.norm(shapes[-1].mean(1) - shapes[0].mean(1), axis=1)
    assert (moved > 0.02).mean() > (0.2 if name == "bricks" else 0.8)


def test_owners_number_bodies():
    meshes = [built("bricks", 0, 0.1).deforming["brick"].part.mesh] * 2
    vertex, face = owners(meshes)
    assert (np.bincount(vertex) == len(meshes[0].vertices)).all() and (np.bincount(face) == len(meshes[0].faces)).all()


def test_wings_are_mirror_images_that_beat_and_do_not_stretch():
    beat = bird_body.Beat()
    for t in np.linspace(0, 1 / beat.hz, 9):
        left, right = np.split(bird_body.wing_points(beat, t), 2)
        np.testing.assert_allclose(left * [1, -1, 1], right, atol=1e-12)
        np.testing.assert_allclose(left, np.split(bird_body.wing_points(beat, t + 1 / beat.hz), 2)[0], atol=1e-9)
        front = left.reshape(33, 9, 3)[:, 0]
        reach = np.linalg.norm(np.diff(front[:, 1:], axis=0), axis=1).sum()
        assert reach == pytest.approx(bird_body.SPAN_M, rel=1e-6)
    tips = [bird_body.wing_points(beat, t).reshape(2, 33, 9, 3)[0, -1, 0, 2] for t in np.linspace(0, 1 / beat.hz, 30)]
    assert max(tips) - min(tips) > 0.2
