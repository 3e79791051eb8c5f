"""The worlds as plain data: geometry, motion, reproducibility. No image is rendered here; a few rays are cast."""

from __future__ import annotations

import hashlib
import itertools

import numpy as np
import pytest
from board_array import visible
from built_worlds import built
from scipy.spatial import cKDTree

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.recorder.rig_calibration.board_clip import DISTANCE_M
from spike4dgs.generators.recorder.rig_calibration.board_place import LEAST_SEEN, place_board
from spike4dgs.generators.rendering.image_motion import carried, key_plan, max_image_speed
from spike4dgs.generators.rendering.mitsuba_scene import MitsubaScene, mitsuba_scene
from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.generators.rendering.render import make_tracer
from spike4dgs.generators.rendering.scalar_tiles import load_sensor
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import OURS, WORLDS, Part, WorldScene, bicycle, motor, turntable
from spike4dgs.generators.worlds.base import rng_for
from spike4dgs.generators.worlds.parts import van_body, vehicle

WIDTH, HEIGHT = 64, 40
NAMES = sorted(WORLDS)
STREET = ["jaywalk", "bicycle", "motor", "car", "van"]
WHEELS = {  # of each street's vehicle, one and its radius
    "bicycle": ("front_wheel", bicycle.WHEEL_M),
    "motor": ("rear_wheel", motor.WHEEL_M),
    "car": ("rim0", vehicle.WHEEL_RADIUS_M),
    "van": ("rim0", van_body.WHEEL_M),
}


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
    """Return a hash over all meshes, materials, lights and two poses."""
    digest = hashlib.sha256()
    for part in all_parts(world):
        for array in (part.mesh.vertices, part.mesh.faces, part.mesh.uv, np.asarray(part.material.albedo)):
            digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(repr(sorted(world.emitters.items())).encode())
    for t_s in (0.003, 0.017):
        digest.update(world.moving_points(t_s).tobytes())
    return digest.hexdigest()


class Drawn(Exception):
    """Carries the seed of a generator."""


def test_a_world_is_a_function_of_seed_and_variant(name, monkeypatch):
    """What draws its numbers from other seeds is another world, and need not be built for that."""
    build, first = WORLDS[name].build, fingerprint(built(name))
    assert fingerprint(build(0, 0, 0.02)) == first
    assert fingerprint(built(name, 1)) != first

    def draw(seed=None):
        raise Drawn(str(seed))

    monkeypatch.setattr(np.random, "default_rng", draw)
    seeds = set()
    for seed, variant in itertools.product((0, 1), (0, 1)):
        with pytest.raises(Drawn) as drawn:
            build(seed, variant, 0.02)
        seeds.add(str(drawn.value))
    assert len(seeds) == 4 and "None" not in seeds


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
    world = built("blank")
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
    if name in STREET:
        check_crossing(world)
    if name in WHEELS:
        check_rolling(world, *WHEELS[name])


def check_crossing(world: WorldScene) -> None:
    """All nine cameras see it cross from left to right, the middle one through the middle."""
    times = world.duration_s / 2 + np.linspace(-0.25, 0.25, 6)
    middle = np.array([world.moving_points(t)[:, 0].mean() for t in times])
    assert np.polyfit(times, middle, 1)[0] == pytest.approx(world.notes["speed_m_s"], rel=0.03)
    points = [world.moving_points(t) for t in (0.0, 0.01, 0.02)]
    for camera in cameras(world, WIDTH, HEIGHT):
        across = [camera.project(p)[0][:, 0].mean() for p in points]
        assert 0 < across[0] < across[1] < across[2] < WIDTH
        assert camera.id != "cam_04" or abs(across[1] - WIDTH / 2) < 0.05 * WIDTH


def check_rolling(world: WorldScene, wheel: str, radius: float) -> None:
    """The point of the tyre that touches the ground is at rest."""
    before, after = (world.poses(t)[wheel] for t in (0.03, 0.03 + 1e-6))
    contact = before[:3, 3] - [0, 0, radius]
    local = np.linalg.inv(before) @ np.append(contact, 1)
    assert np.linalg.norm((after @ local)[:3] - contact) / 1e-6 < 1e-3 * world.notes["speed_m_s"]


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
        points = [world.moving_points(s) for s in (t, t + 1e-4)]
        for camera in rig:
            (uv, z), (later, _) = map(camera.project, points)
            seen = (z > 0) & (uv > 0).all(1) & (uv < [WIDTH, HEIGHT]).all(1)
            fastest = max(fastest, np.linalg.norm(later - uv, axis=1)[seen].max() / 1e-4)
    assert 0.9 * bound < fastest < 1.02 * bound


def test_every_camera_of_every_world_sees_a_board(name):
    """The rigs of the worlds of a desk have the usual board, those of a street a larger one."""
    if name not in OURS:
        return
    given = cameras(built(name), 400, 250)
    place = place_board(given, 8, 5)
    assert min(visible(place)) >= LEAST_SEEN and min(place.seen.values()) >= LEAST_SEEN
    assert place.square_px > 15
    for a, b, own in zip(place.cameras, place.cameras[1:], given, strict=False):
        assert a.id == own.id and np.linalg.norm(a.center - b.center) > 0.01
    if name not in STREET:
        half_field = max(c.width / (2 * c.fx) for c in place.cameras)
        assert place.board.square_m == 0.04
        assert place.distance_m == pytest.approx(DISTANCE_M * np.tan(np.radians(17)) / half_field)


def test_odd_turntables_are_hard():
    for variant in range(40):
        turns = turntable._sample(variant, rng_for("turntable", 0, variant)).turns_per_s
        low, high = (20, 25) if variant % 2 else (4, 5.5)
        assert low <= abs(turns) <= high and (variant or turns == 5)
    for world in (built("turntable", v) for v in (0, 1)):
        step, rim = 1e-6, np.array([turntable.DISC_RADIUS_M, 0, 0, 1])
        moved = (world.poses(0.01 + step)["disc"] - world.poses(0.01)["disc"]) @ rim
        assert np.linalg.norm(moved) / step == pytest.approx(world.notes["speed_m_s"], rel=1e-4)


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
