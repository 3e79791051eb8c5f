"""The worlds as plain data: geometry, motion, reproducibility. No image is rendered here; a few rays are cast."""

from __future__ import annotations

import hashlib
import itertools

import numpy as np
import pytest
from built_worlds import built
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.rendering.image_motion import KeyPlan, carried, key_plan, max_image_speed, spacings
from spike4dgs.generators.rendering.mitsuba_scene import MitsubaScene, mitsuba_scene
from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.generators.rendering.render import make_tracer
from spike4dgs.generators.rendering.scalar_tiles import load_sensor
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WORLDS, Part, WorldScene

WIDTH, HEIGHT = 64, 40
NAMES = sorted(WORLDS)
STREET = ["jaywalk", "bicycle", "motor", "car", "van"]


@pytest.fixture(scope="module", params=NAMES)
def name(request) -> str:
    """A world's name; all tests of one world come after each other, and build it once."""
    return request.param


@pytest.fixture(scope="module")
def scene(name) -> MitsubaScene:
    """The world in Mitsuba, at any time."""
    return mitsuba_scene(built(name))


def all_parts(world: WorldScene) -> list[Part]:
    rigid = [part for group in world.groups.values() for part in group]
    return [*world.static.values(), *rigid, *(surface.part for surface in world.deforming.values())]


def fingerprint(world: WorldScene) -> str:
    """Return a hash over all meshes, materials, lights and a pose."""
    digest = hashlib.sha256()
    for part in all_parts(world):
        for array in (part.mesh.vertices, part.mesh.faces, part.mesh.uv, np.asarray(part.material.albedo)):
            digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(repr(sorted(world.emitters.items())).encode())
    digest.update(world.moving_points(0.003).tobytes())
    return digest.hexdigest()


def test_a_world_is_a_function_of_seed_and_variant(name):
    build, first = WORLDS[name].build, fingerprint(built(name))
    assert fingerprint(build(0, 0, 0.02)) == first
    assert fingerprint(build(1, 0, 0.02)) != first
    assert fingerprint(built(name, 1)) != first


def test_meshes_and_materials_are_sound(name):
    world = built(name)
    for part in all_parts(world):
        mesh = part.mesh
        assert np.isfinite(mesh.vertices).all() and np.isfinite(mesh.uv).all()
        assert mesh.uv.shape == (len(mesh.vertices), 2)
        assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)
        albedo = np.asarray(part.material.albedo)
        assert np.isfinite(albedo).all() and albedo.shape[-1] == 3
    for surface in world.deforming.values():
        assert surface.vertices(0.007).shape == surface.part.mesh.vertices.shape
        assert surface.bodies is None or len(surface.bodies) == len(surface.part.mesh.faces)
    assert set(world.poses(0.0)) == set(world.instances)
    for pose in world.poses(0.007).values():  # rigid: nothing is stretched or mirrored
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) > 0


def test_the_array_is_named_row_by_row_from_the_top_left():
    world = built("car")
    rig = cameras(world, WIDTH, HEIGHT)
    centers = np.stack([c.center for c in rig]).reshape(3, 3, 3)
    assert [c.id for c in rig] == [f"cam_{k:02d}" for k in range(9)]
    assert (np.diff(centers[..., 0], axis=1) > 0).all()  # to the right
    assert (np.diff(centers[..., 2], axis=0) < 0).all()  # down
    with pytest.raises(UserError, match="views"):
        cameras(world, WIDTH, HEIGHT, (0, 9))
    with pytest.raises(UserError, match="resolution"):
        cameras(world, 0, HEIGHT)


def sensor_rays(camera: Camera, sent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and directions [N, 3] of Mitsuba's own rays through positions `sent` [N, 2] in the image, 0..1."""
    mi = load_mitsuba()
    sensor = load_sensor(camera, {"type": "hdrfilm", "width": camera.width, "height": camera.height}, 1)
    if mi.variant().startswith("scalar"):
        rays = [sensor.sample_ray(0, 0.5, mi.Point2f(*p), mi.Point2f(0.5, 0.5))[0] for p in sent.tolist()]
        return np.array([list(r.o) for r in rays]), np.array([list(r.d) for r in rays])
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(sent.T.astype(np.float32)), mi.Point2f(0.5, 0.5))
    return np.array(ray.o).T + np.zeros((len(sent), 3)), np.array(ray.d).T


def test_points_that_mitsubas_rays_hit_project_to_where_the_rays_started(name, scene):
    world = built(name)
    rig = cameras(world, WIDTH, HEIGHT)
    scene.set_time(0.008)
    tracer = make_tracer(scene, rig, 0)
    sent = np.random.default_rng(0).random((len(rig), 100, 2))
    origins, directions = map(np.concatenate, zip(*map(sensor_rays, rig, sent), strict=True))
    rays = tracer.prepare(origins, directions)
    distance = np.minimum(tracer.cast_static(rays)[0], tracer.cast_movers(rays).distance)
    points = (origins + directions * distance[:, None]).reshape(len(rig), 100, 3)
    for camera, places, met in zip(rig, sent, points, strict=True):
        uv, z = camera.project(met)
        assert (z > world.depth_range[0]).all() and (z < world.depth_range[1]).all()
        assert np.abs(uv - places * [WIDTH, HEIGHT]).max() < 0.01


def test_moving_triangles_are_where_the_world_says(name, scene):
    world, t_s = built(name), 0.0131
    scene.set_time(t_s)
    rig = cameras(world, WIDTH, HEIGHT, (4,))
    rng = np.random.default_rng(0)
    poses, middles, owners = world.poses(t_s), [], []
    count = max(12, 120 // max(1, sum(len(world.groups[group]) for group in world.instances.values())))  # of a part
    for number, (instance, group) in enumerate(world.instances.items()):
        for part in world.groups[group]:
            faces = part.mesh.faces[rng.integers(len(part.mesh.faces), size=count)]
            local = part.mesh.vertices[faces].mean(1)
            middles.append(local @ poses[instance][:3, :3].T + poses[instance][:3, 3])
            owners.append(np.full(count, number))
    for number, surface in enumerate(world.deforming.values(), start=len(world.instances)):
        faces = surface.part.mesh.faces[rng.integers(len(surface.part.mesh.faces), size=60)]
        middles.append(surface.vertices(t_s)[faces].mean(1))
        owners.append(np.full(60, number))
    ways, owner = np.concatenate(middles) - rig[0].center, np.concatenate(owners)
    expected = np.linalg.norm(ways, axis=1)
    tracer = make_tracer(scene, rig, 0)
    hits = tracer.cast_movers(tracer.prepare(np.repeat(rig[0].center[None], len(ways), 0), ways / expected[:, None]))
    # the triangle itself, or a surface in front of it; float32 rays may miss slivers and edges
    assert (hits.distance < expected * 1.0005).mean() > 0.97
    met = np.abs(hits.distance - expected) < 5e-4 * expected
    assert met.sum() > 20 and (hits.number[met] == owner[met]).mean() > 0.9  # parts touch each other at joints
    later = carried(world, hits, rig[0].center + ways, t_s, t_s + 1e-3)[met & (hits.number == owner)]
    parts = [world.moving_points(t) for t in (t_s, t_s + 1e-3)]
    nearest = cKDTree(parts[1]).query(later)[0]  # carried points are on the moved surface, between its vertices
    assert np.median(nearest) < 1.5 * np.median(cKDTree(parts[0]).query((rig[0].center + ways)[met])[0]) + 1e-6


def is_fast(world: WorldScene) -> bool:
    """Return whether a camera of 30 images a second would smear it over a quarter of its length."""
    return world.notes["speed_m_s"] / 30 >= world.notes["length_m"] / 4


@pytest.mark.parametrize("variant", [0, 1])
def test_objects_are_fast_stay_above_the_ground_and_cross_streets_from_left_to_right(name, variant):
    world = built(name, variant)
    assert is_fast(world)
    reach_s, depth_m = (0.25, 0.03) if name in STREET else (0.05, 0.004)
    for t in world.duration_s / 2 + np.linspace(-reach_s, reach_s, 7):
        assert world.moving_points(t)[:, 2].min() > -depth_m
    if name not in STREET:
        return
    times = world.duration_s / 2 + np.linspace(-0.25, 0.25, 6)
    middle = np.array([world.moving_points(t)[:, 0].mean() for t in times])
    assert np.polyfit(times, middle, 1)[0] == pytest.approx(world.notes["speed_m_s"], rel=0.03)
    (camera,) = cameras(world, 400, 250, (4,))
    across = [camera.project(world.moving_points(t))[0][:, 0].mean() for t in (0.0, 0.01, 0.02)]
    assert across[0] < across[1] < across[2] and abs(across[1] - 200) < 60


def test_the_car_crosses_from_left_to_right_through_the_middle():
    world = built("car")
    for camera in cameras(world, WIDTH, HEIGHT):
        across = [camera.project(world.moving_points(t))[0][:, 0].mean() for t in np.linspace(0, 0.02, 5)]
        assert (np.diff(across) > 0).all()
        assert 0 < across[0] < across[-1] < WIDTH
    middle = cameras(world, WIDTH, HEIGHT, (4,))[0].project(world.moving_points(0.01))[0][:, 0].mean()
    assert abs(middle - WIDTH / 2) < 0.05 * WIDTH


def test_the_disc_turns_in_place_counter_clockwise_from_above():
    world = built("turntable")
    camera = cameras(world, WIDTH, HEIGHT, (4,))[0]
    points = world.moving_points(0.004)
    uv, uv_later = (camera.project(world.moving_points(t))[0] for t in (0.004, 0.005))
    right = uv_later[:, 0] - uv[:, 0]
    near, far = points[:, 1] < -0.25, points[:, 1] > 0.25
    assert (right[near] > 0).all() and (right[far] < 0).all()
    assert np.abs(points.mean(0) - world.moving_points(0.005).mean(0)).max() < 0.02


def test_the_speed_bound_holds_for_finite_steps(name):
    world = built(name)
    rig = cameras(world, WIDTH, HEIGHT, (0, 4))
    bound = max_image_speed(world, rig, 0.02)
    fastest = 0.0
    for t in np.linspace(0.001, 0.019, 7):
        for camera in rig:
            (uv, z), (later, _) = (camera.project(world.moving_points(s)) for s in (t, t + 1e-4))
            seen = (z > 0) & (uv > 0).all(1) & (uv < [WIDTH, HEIGHT]).all(1)
            fastest = max(fastest, np.linalg.norm(later - uv, axis=1)[seen].max() / 1e-4)
    assert 0.9 * bound < fastest < 1.02 * bound
    doubled = max_image_speed(world, cameras(world, 2 * WIDTH, 2 * HEIGHT, (0, 4)), 0.02)
    assert doubled == pytest.approx(2 * bound, rel=1e-3)


@settings(max_examples=200, deadline=None)
@given(
    speed=st.floats(0, 1e6),
    n_ticks=st.integers(1, 20_000),
    per_ms=st.sampled_from([1, 7, 10, 20, 40]),
    max_px=st.floats(0.05, 4),
)
def test_spacings_and_the_ticks_they_give(speed, n_ticks, per_ms, max_px):
    rate_hz = 1000 * per_ms
    chain = spacings(speed, n_ticks, rate_hz, max_px)
    plan = KeyPlan(n_ticks, rate_hz, max_px, chain)
    assert per_ms % chain[0] == 0  # so every whole millisecond is a whole key
    assert all(a > b and a % b == 0 for a, b in itertools.pairwise(chain))
    finest = chain[-1]
    assert finest == 1 or speed * finest / rate_hz <= max_px
    wider = [d for d in range(finest + 1, per_ms + 1) if per_ms % d == 0]
    assert not wider or speed * wider[0] / rate_hz > max_px  # and it is the widest
    assert len(chain) == 1 or speed * chain[0] / rate_hz <= 2.5
    ticks = plan.ticks
    assert ticks[0] == 0 and set(np.diff(ticks)) == {finest}
    assert ticks[-1] - chain[0] < n_ticks <= ticks[-1] and ticks[-1] % chain[0] == 0
    for tick in ticks[:50]:
        level = plan.level(tick)
        assert tick % chain[level] == 0 and all(tick % coarser for coarser in chain[:level])


@pytest.mark.parametrize(
    "arguments", [(1.0, 10, 20_500, 0.5), (1.0, 0, 20_000, 0.5), (1.0, 10, 500, 0.5), (1.0, 10, 20_000, 0.0)]
)
def test_spacings_refuse_what_they_cannot_divide(arguments):
    with pytest.raises(UserError, match="key frames"):
        spacings(*arguments)


def test_plans_follow_the_speed_and_the_switches():
    slow, fast = (built("turntable", v) for v in (0, 1))
    rig = cameras(slow, 400, 250, (4,))
    assert key_plan(slow, rig, 400, 20_000, 0.5).sub_ticks == 1
    hard = key_plan(fast, rig, 400, 20_000, 0.5)
    assert hard.chain[-1] == 1 and hard.sub_ticks in (1, 2)
    assert key_plan(fast, rig, 400, 20_000, 0.1).sub_ticks == 8
    assert key_plan(fast, rig, 400, 20_000, 0.1, sub_ticks=False).sub_ticks == 1
    exact = key_plan(slow, rig, 400, 20_000, 0.5, adaptive=False)
    assert exact.chain == (1,) and len(exact.ticks) == 401
