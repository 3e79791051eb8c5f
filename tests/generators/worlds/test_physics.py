"""Bricks and chips obey mechanics: energy, momentum, solid bodies, flight. References are closed forms."""

from __future__ import annotations

from functools import lru_cache
from unittest import mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from spike4dgs.generators.worlds import WorldScene, bricks, chips
from spike4dgs.generators.worlds.meshes import box
from spike4dgs.generators.worlds.parts import rigid_bodies
from spike4dgs.generators.worlds.parts.rigid_bodies import GRAVITY_M_S2, SOFT_M, STEP_S, Body, Trajectory, simulate
from spike4dgs.generators.worlds.textures import _font

MODULES = {"bricks": bricks, "chips": chips}
CASES = [("bricks", 0), ("bricks", 2), ("chips", 0), ("chips", 5)]


@lru_cache
def simulated(name: str, variant: int, duration_s: float = 0.1) -> tuple[WorldScene, list[Body], Trajectory]:
    """Return a world, its simulated bodies, and their trajectory."""
    seen = []

    def watched(bodies, *arguments, **options):
        seen.append((bodies, simulate(bodies, *arguments, **options)))
        return seen[-1][1]

    with mock.patch.object(MODULES[name], "simulate", watched):
        world = MODULES[name].build(0, variant, duration_s)
    ((bodies, path),) = seen
    return world, bodies, path


def mass_and_inertia(body: Body) -> tuple[float, np.ndarray]:
    """Return mass in kg and principal moments [3] in kg m^2, from textbook formulas."""
    if body.shape == "box":
        a, b, c = 2 * np.array(body.size)
        mass = body.density * a * b * c
        return mass, mass / 12 * np.array([b * b + c * c, a * a + c * c, a * a + b * b])
    if body.shape == "sphere":
        mass = body.density * 4 / 3 * np.pi * body.size[0] ** 3
        return mass, np.full(3, 0.4 * mass * body.size[0] ** 2)
    radius, half = body.size
    mass = body.density * np.pi * radius**2 * 2 * half
    across = mass * (3 * radius**2 + 4 * half**2) / 12
    return mass, np.array([across, across, mass * radius**2 / 2])


def velocities(path: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return velocity in m/s and spin in rad/s about the body's axes, [T - 1, B, 3] each, from pose differences."""
    velocity = np.diff(path.positions, axis=0) / STEP_S
    q = path.quaternions[..., [1, 2, 3, 0]]
    turn = Rotation.from_quat(q[:-1].reshape(-1, 4)).inv() * Rotation.from_quat(q[1:].reshape(-1, 4))
    return velocity, turn.as_rotvec().reshape(velocity.shape) / STEP_S


def energy(bodies: list[Body], path: Trajectory) -> np.ndarray:
    """Return kinetic and potential energy [T - 1] in joules."""
    mass, inertia = (np.array(x) for x in zip(*map(mass_and_inertia, bodies), strict=True))
    velocity, spin = velocities(path)
    moving = 0.5 * (mass * (velocity**2).sum(-1) + (inertia * spin**2).sum(-1))
    return (moving + mass * GRAVITY_M_S2 * path.positions[1:, :, 2]).sum(1)


@pytest.mark.parametrize(("name", "variant"), CASES)
def test_energy_falls_except_for_what_contacts_return(name, variant):
    _, bodies, path = simulated(name, variant)
    total = energy(bodies, path)
    assert total.max() <= total[0] * (1 + 1e-4)
    low = np.minimum.accumulate(total)
    when = np.maximum.accumulate(np.where(total == low, np.arange(len(total)), 0))
    taken = total[np.maximum(when - 40, 0)] - low  # by contacts during the 2 ms before
    assert (total - low <= 0.25 * taken + 1e-3 * total[0]).all()
    assert total[-1] < 0.95 * total[0]


@pytest.mark.parametrize("variant", [0, 5])
def test_the_middle_of_all_chips_falls_on_a_parabola_until_the_first_lands(variant):
    _, bodies, path = simulated("chips", variant)
    reach = np.hypot(chips.RADIUS_M, chips.THICK_M / 2)
    landing = int(np.argmax(path.positions[..., 2].min(1) < reach))
    assert landing > 50
    t = STEP_S * np.arange(landing)[:, None]
    start, velocity = (np.mean([getattr(b, key) for b in bodies], 0) for key in ("position", "velocity"))
    expected = start + velocity * t - [0, 0, GRAVITY_M_S2 / 2] * t**2
    tolerance = GRAVITY_M_S2 * STEP_S * t[-1, 0]  # twice the error of the first-order step
    np.testing.assert_allclose(path.positions[:landing].mean(1), expected, atol=tolerance)


def test_chips_that_collide_in_the_air_keep_momentum_and_angular_momentum():
    rng = np.random.default_rng(3)
    bodies = []
    for k in range(12):  # thrown at each other from a circle
        a = 2 * np.pi * k / 12
        position = (0.12 * np.cos(a), 0.12 * np.sin(a), 1.0)
        velocity = (-3 * np.cos(a), -3 * np.sin(a), rng.normal(0, 0.1))
        q, spin = rng.normal(size=4), tuple(rng.normal(0, 22, 3).tolist())
        turn = tuple((q / np.linalg.norm(q)).tolist())
        bodies.append(Body("cylinder", (0.024, 0.00225), position, turn, velocity, spin, 1800.0))
    path = simulate(bodies, 0.0, 0.08)
    mass, inertia = mass_and_inertia(bodies[0])
    velocity, spin = velocities(path)
    assert np.linalg.norm(velocity[-1, :, :2] - velocity[0, :, :2], axis=1).min() > 1  # every one was hit
    middle = velocity.mean(1)
    falling = middle[0] - np.outer(STEP_S * np.arange(len(middle)), [0, 0, GRAVITY_M_S2])
    np.testing.assert_allclose(middle, falling, atol=1e-9)
    arm = path.positions[1:] - path.positions[1:].mean(1, keepdims=True)
    orbital = mass * np.cross(arm, velocity - middle[:, None]).sum(1)
    turns = Rotation.from_quat(path.quaternions[1:].reshape(-1, 4)[:, [1, 2, 3, 0]])
    own = turns.apply((inertia * spin).reshape(-1, 3)).reshape(spin.shape).sum(1)
    moment, scale = orbital + own, mass * 12 * 3 * chips.RADIUS_M
    assert np.abs(own - own[0]).max() > 0.02 * scale  # it went from one kind to the other
    np.testing.assert_allclose(moment, np.broadcast_to(moment[0], moment.shape), atol=2e-3 * scale)


def test_a_ball_sinks_in_and_bounces_as_documented():
    for speed in (1.0, 3.5):
        drop = Body("sphere", (0.02,), (0, 0, 0.021), velocity=(0, 0, -speed))
        height = simulate([drop], 0.0, 0.01).positions[:, 0, 2]
        upward = np.diff(height) / STEP_S
        assert 0.04e-3 * speed < 0.02 - height.min() < 0.12e-3 * speed
        assert upward.max() / speed == pytest.approx(0.25, abs=0.08)


def test_spin_is_given_in_world_coordinates():
    for name in ("chips", "bricks"):
        _, bodies, path = simulated(name, 0)
        turns = Rotation.from_quat(path.quaternions[0][:, [1, 2, 3, 0]])
        spin = turns.apply(velocities(path)[1][0])
        np.testing.assert_allclose(spin, [b.spin for b in bodies], atol=0.2)  # a step of precession


def local_points(path: Trajectory, t_s: float, points: np.ndarray) -> np.ndarray:
    """Return world points [B, P, 3], P for each body, in every body's coordinates: [B, B, P, 3] (seen by, owned by)."""
    turn, position = path.at(t_s)
    return np.einsum("aji,abpj->abpi", turn, points[None] - position[:, None, None])


@pytest.mark.parametrize(("name", "variant"), CASES)
def test_bodies_stay_rigid_and_do_not_enter_each_other_or_the_table(name, variant):
    world, bodies, path = simulated(name, variant)
    (surface,) = world.deforming.values()
    count = len(bodies) - len(world.instances)
    assert surface.bodies.max() == count - 1
    own = Trajectory(path.start_s, path.positions[:, :count], path.quaternions[:, :count])
    others, every, shape = ~np.eye(count, dtype=bool), np.arange(count), None
    for t in np.linspace(0, 0.1, 21):
        points = surface.vertices(t).reshape(count, -1, 3)
        assert points[..., 2].min() > -SOFT_M
        seen = local_points(own, t, points)
        shape = seen[every, every] if shape is None else shape
        np.testing.assert_allclose(seen[every, every], shape, atol=1e-9)
        seen = np.abs(seen)
        if name == "bricks":
            depth = (np.array(bricks.BRICK_M) / 2 - seen).min(-1)
        else:
            across = chips.RADIUS_M - np.hypot(seen[..., 0], seen[..., 1])
            depth = np.minimum(across, chips.THICK_M / 2 - seen[..., 2])
        assert depth[others].max() < SOFT_M


@pytest.mark.parametrize("variant", [0, 2])
def test_the_ball_and_the_bricks_stop_at_each_other_and_at_the_room(variant):
    world, _, path = simulated("bricks", variant)
    parts = [part for name, part in world.static.items() if name.startswith(("wall", "book"))]
    walls = [rigid_bodies.Block.around(part.mesh) for part in parts]
    for t in np.linspace(0, 0.1, 41):
        ball = world.poses(t)["ball"][:3, 3]
        turn, position = path.at(t)
        near = np.einsum("aji,aj->ai", turn, ball - position)[:-1]
        gap = np.linalg.norm(np.maximum(np.abs(near) - np.array(bricks.BRICK_M) / 2, 0), axis=1)
        if t >= path.start_s:
            assert gap.min() > bricks.BALL_M - SOFT_M
        corners = world.deforming["brick"].vertices(t)
        for block in walls:
            low, high = np.array(block.low), np.array(block.high) + [0, 10 * (block.high[1] > 0.79), 0]
            assert np.linalg.norm(ball - np.clip(ball, low, high)) > bricks.BALL_M - SOFT_M
            assert np.minimum(corners - low, high - corners).min(1).max() < SOFT_M


def test_bodies_stop_at_blocks():
    block = rigid_bodies.Block.around(box((0.1, 0.4, 0.3), (0.3, 0, 0.15)))
    np.testing.assert_allclose([block.low, block.high], [(0.25, -0.2, 0), (0.35, 0.2, 0.3)])
    ball = Body("sphere", (0.02,), (0, 0, 0.1), velocity=(10.0, 0, 0))
    free, stopped = (simulate([ball], 0.0, 0.05, blocks=b).positions[:, 0, 0].max() for b in ((), [block]))
    assert free == pytest.approx(0.5, abs=1e-3) and 0.23 < stopped < 0.2315


def test_bodies_that_overlap_at_the_beginning_are_refused():
    brick = Body("box", (0.02, 0.02, 0.02), (0, 0, 0.5))
    with pytest.raises(ValueError, match=r"overlap by 5\.00 mm"):
        simulate([brick, Body("box", (0.02, 0.02, 0.02), (0, 0, 0.535))], 0.0, 0.001)
    simulate([brick, Body("box", (0.02, 0.02, 0.02), (0, 0, 0.54))], 0.0, 0.001)


def test_unstable_motion_is_not_returned(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log
    with pytest.raises(FloatingPointError, match="unstable"):
        simulate([Body("sphere", (0.02,), (0, 0, 1.0), velocity=(1e12, 0, 0))], 0.0, 0.001)


def test_poses_between_steps_are_those_of_slerp_and_ignore_the_quaternions_sign():
    rng = np.random.default_rng(0)
    q = Rotation.random(8, random_state=1)
    step = Rotation.from_rotvec(rng.normal(0, 80 * STEP_S, (8, 3)))  # 80 rad/s
    pair = np.stack([r.as_quat()[:, [3, 0, 1, 2]] for r in (q, q * step)])
    positions = rng.normal(size=(2, 8, 3))
    for f in (0.0, 0.25, 0.5, 0.9, 1.0):
        turn, position = Trajectory(0.01, positions, pair).at(0.01 + f * STEP_S)
        exact = [Slerp([0, 1], Rotation.concatenate([a, b]))(f) for a, b in zip(q, q * step, strict=True)]
        np.testing.assert_allclose(turn, [r.as_matrix() for r in exact], atol=1e-8)
        np.testing.assert_allclose(position, (1 - f) * positions[0] + f * positions[1], atol=1e-12)
        flipped = Trajectory(0.01, positions, pair * np.array([1.0, -1.0])[:, None, None]).at(0.01 + f * STEP_S)
        np.testing.assert_allclose(flipped[0], turn, atol=1e-12)


@pytest.mark.parametrize(("name", "variant", "fastest_m_s"), [("bricks", 0, 20.0), ("chips", 0, 6.0)])
def test_nothing_jumps(name, variant, fastest_m_s):
    world, _, path = simulated(name, variant)
    assert np.linalg.norm(np.diff(path.positions, axis=0), axis=-1).max() < fastest_m_s * STEP_S
    assert path.start_s + STEP_S * (len(path.positions) - 1) >= world.duration_s
    for t in (max(path.start_s, 0) + 3 * STEP_S, 0.05, 0.0731):  # at a step and between steps
        before, after = (world.moving_points(t + d) for d in (-1e-9, 1e-9))
        assert np.linalg.norm(after - before, axis=1).max() < 2 * fastest_m_s * 1e-9


def test_the_wall_bursts_in_the_same_way_in_clips_of_any_length():
    (short, _, path), (long, _, longer) = (simulated("bricks", 0, d) for d in (0.02, 0.1))
    np.testing.assert_array_equal(path.positions, longer.positions[: len(path.positions)])
    np.testing.assert_allclose(short.moving_points(0.012), long.moving_points(0.052), atol=1e-9)


@pytest.mark.parametrize("variant", [0, 2])
def test_the_ball_meets_the_wall_35_ms_before_the_middle(variant):
    world, _, path = simulated("bricks", variant)
    wall = [world.deforming["brick"].vertices(t) for t in (0.0, 0.0149, 0.0152, 0.05)]
    np.testing.assert_allclose(wall[1], wall[0], atol=1e-5)
    assert 1e-4 < np.abs(wall[2] - wall[0]).max() < 0.01
    step = np.diff(path.positions, axis=0)[round((0.05 - path.start_s) / STEP_S), :-1]
    flying = np.linalg.norm(step, axis=1) / STEP_S > 30 * bricks.BRICK_M[0] / 4  # a slow camera smears these
    assert flying.sum() > 15


def test_the_ball_flies_on_one_arc_before_and_after_the_simulation_begins():
    world, bodies, path = simulated("bricks", 0, 0.5)
    start, ball = path.start_s, bodies[-1]
    assert 0.2 < start < 0.22
    before, after = (world.poses(start + d)["ball"] for d in (-1e-7, 1e-7))
    np.testing.assert_allclose(before, after, atol=2e-7 * 1.1 * np.linalg.norm([*ball.velocity, *ball.spin]))
    steps = [world.poses(start + d)["ball"][:3, 3] - world.poses(start)["ball"][:3, 3] for d in (-1e-3, 1e-3)]
    np.testing.assert_allclose(steps[0], -steps[1], atol=1.1 * GRAVITY_M_S2 * 1e-6)
    first = world.poses(start - 0.01)["ball"]
    quaternion = tuple(Rotation.from_matrix(first[:3, :3]).as_quat()[[3, 0, 1, 2]].tolist())
    velocity = (*ball.velocity[:2], ball.velocity[2] + GRAVITY_M_S2 * 0.01)
    thrown = Body("sphere", ball.size, tuple(first[:3, 3].tolist()), quaternion, velocity, ball.spin)
    turn, position = simulate([thrown], 0.0, 0.02).at(0.01)
    np.testing.assert_allclose(position[0], ball.position, atol=GRAVITY_M_S2 * 0.01 * STEP_S)
    np.testing.assert_allclose(turn[0], np.eye(3), atol=1e-6)
    heights = [world.poses(t)["ball"][2, 3] for t in np.linspace(0, 0.5, 40)]
    assert min(heights) > bricks.BALL_M - SOFT_M


@pytest.mark.parametrize(("variant", "duration_s"), [(0, 0.004), (0, 0.1), (3, 0.5)])
def test_most_chips_are_in_the_air_in_the_middle_of_the_clip(variant, duration_s):
    world, bodies, path = simulated("chips", variant, duration_s)
    low = world.deforming["chip"].vertices(duration_s / 2).reshape(len(bodies), -1, 3)[..., 2].min(1)
    assert (low > 0.01).mean() > 0.75 and (low < 0.03).any() and np.std(low) > 0.06
    k = round((duration_s / 2 - path.start_s) / STEP_S)
    fall = -np.diff(path.positions, axis=0)[k, low > 0.1, 2] / STEP_S
    assert np.median(fall) == pytest.approx(world.notes["speed_m_s"], rel=0.06)
    apart = np.linalg.norm(path.positions[0][:, None] - path.positions[0][None], axis=-1)
    assert apart[np.triu_indices(len(bodies), 1)].min() > 2 * np.hypot(chips.RADIUS_M, chips.THICK_M / 2)


def test_words_fit_on_whole_bricks():
    width = (bricks.COLUMNS - 0.5) * bricks.BRICK_M[0]  # where all rows have bricks
    world, _, _ = simulated("bricks", 0)
    part = world.deforming["brick"].part
    assert part.mesh.uv.min() >= 0 and part.mesh.uv.max() <= 1
    for word, height in bricks._WORDS.items():
        left, _, right, _ = _font(200).getbbox(word)
        assert 0.9 * width < (right - left) / 200 / 0.73 * height < width
