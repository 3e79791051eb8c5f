"""Key frames: traced and reused pixels, and the error of both against a plain full rendering."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from built_worlds import built as world
from built_worlds import forget_scenes
from matplotlib.path import Path
from scipy.ndimage import binary_erosion as erode
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import gray as gray_of
from spike4dgs.generators.rendering.image_motion import KeyPlan, narrow_corners
from spike4dgs.generators.rendering.keyframes import KeyStore
from spike4dgs.generators.rendering.render import MultiViewRenderer, StaticViews, make_tracer
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import Deforming, Part, WorldScene
from spike4dgs.generators.worlds.meshes import ellipsoid, merge, quad, rotation
from spike4dgs.generators.worlds.parts.rigid_bodies import owners
from spike4dgs.generators.worlds.surfaces import Material

WIDTH, HEIGHT, SPP, BACKGROUND_SPP = 64, 40, 32, 64
NAMES = ["car", "turntable"]  # rigid; surfaces that deform are in the second half
T_S = 0.0113
NOISE = 0.03  # bound on the mean absolute error


# of tests of what no world changes
one_world = pytest.mark.parametrize("r", ["turntable"], indirect=True)


@pytest.fixture(scope="module", params=NAMES)
def r(request) -> MultiViewRenderer:
    """One renderer at a time for all tests of a world: LLVM recompiles for all scenes in memory."""
    forget_scenes()
    rig = cameras(world(request.param), WIDTH, HEIGHT, (1, 4))
    return MultiViewRenderer(world(request.param), rig, seed=0, spp=SPP, background_spp=BACKGROUND_SPP)


@pytest.fixture(scope="module")
def key(r) -> np.ndarray:
    return r.keys(T_S)


@pytest.fixture(scope="module")
def full(r) -> np.ndarray:
    return r.crn_frames(T_S)


def test_keys_are_the_full_rendering_inside_and_the_background_outside(r, key, full):
    traced, changed, mask = r.traced(T_S), r.changed(T_S), r.object_masks(T_S)
    assert 0.02 < traced.mean() < 0.6 and (traced <= changed).all() and not changed.all()
    background, same_numbers = (gray_of(a) for a in r.static.arrays().values())
    assert np.array_equal(key[mask], full[mask])
    shadow = traced & ~mask  # the background and the difference that the shadow makes, from the same random numbers
    assert np.array_equal(key[shadow], np.maximum(full + (background - same_numbers), 0)[shadow])
    assert np.array_equal(key[~changed], r.background[~changed])


def test_keys_are_close_to_mitsubas_own_rendering(r, key):
    truth, traced = r.reference_frames(T_S, 128), r.traced(T_S)
    assert np.isfinite(key).all() and key.min() >= 0 and key.max() < 4
    error = key - truth
    assert np.abs(error).mean() < NOISE
    assert abs(error.mean()) < 0.002
    smooth, plain = (gaussian_filter(e, (0, 3, 3))[~traced] for e in (error, r.background - truth))
    assert np.abs(smooth).mean() < 0.65 * np.abs(plain).mean()  # relighting removes the error above the noise
    assert np.abs(smooth).max() < 0.03


def test_masks_and_depths_belong_together(r):
    mask, depth = r.object_masks(T_S), r.depths(T_S)
    static, moving = r._static_hits[0].reshape(r.shape), r._snapshot(T_S).hits.distance.reshape(r.shape)
    assert 0.01 < mask.mean() < 0.5
    assert (moving[mask] < static[mask]).all()
    assert (moving[~mask] >= static[~mask]).all()
    near, far = r.world.depth_range
    assert (depth > near).all() and (depth < far).all()
    assert (r.traced(T_S) | ~mask).all()


def test_images_move_as_the_geometry(r, key):
    """Warping one key by depth and pose gives another key: sides, direction of motion and textures all agree."""
    t0, t1 = 0.004, T_S
    first, second, mask, depth = r.keys(t0)[1], key[1], r.object_masks(t0)[1], r.depths(t0)[1]
    camera = r.cameras[1]
    rows, columns = np.nonzero(mask)
    points = camera.unproject(np.stack([columns + 0.5, rows + 0.5], 1), depth[mask].astype(np.float64))
    main = next(iter(r.world.instances))
    motion = r.world.poses(t1)[main] @ np.linalg.inv(r.world.poses(t0)[main])
    uv, _ = camera.project(points @ motion[:3, :3].T + motion[:3, 3])
    warped = map_coordinates(second, [uv[:, 1] - 0.5, uv[:, 0] - 0.5], order=1, mode="nearest")
    right = np.abs(warped - first[mask]).mean()
    back, _ = camera.project(points @ np.linalg.inv(motion)[:3, :3].T + np.linalg.inv(motion)[:3, 3])
    wrong = np.abs(map_coordinates(second, [back[:, 1] - 0.5, back[:, 0] - 0.5], order=1) - first[mask]).mean()
    assert right < 0.6 * np.abs(second[mask] - first[mask]).mean()
    assert right < 0.5 * wrong


@one_world
def test_a_key_depends_on_the_seed_and_the_time_alone(r, key):
    r.keys(0.002)  # earlier renderings and other views have no influence
    alone = MultiViewRenderer(r.world, r.cameras[1:], seed=0, spp=SPP, background_spp=BACKGROUND_SPP)
    mask = alone.object_masks(T_S)[0]
    assert alone.background[0].tobytes() == r.background[1].tobytes()
    assert alone.keys(T_S)[0][mask].tobytes() == key[1][mask].tobytes()
    other = make_tracer(r._scene, r.cameras, 1).trace(np.arange(r.background.size), SPP, 0, False) * r.world.exposure
    first = r.static.first.reshape(-1, 3)
    assert not np.array_equal(first, other) and abs(first.mean() - other.mean()) < 0.01


@one_world
def test_a_renderer_continues_from_the_background_of_another(r):
    plan, static = KeyPlan(400, 20_000, 0.05, (20, 4, 2)), StaticViews.from_arrays(r.static.arrays())
    second = MultiViewRenderer(r.world, r.cameras, seed=0, spp=SPP, background_spp=BACKGROUND_SPP, static=static)
    for tick in (220, 222):
        a, b = r.key_arrays(tick, plan), second.key_arrays(tick, plan)
        assert a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)


@one_world
def test_colour_is_the_same_image(r, key):
    colour = MultiViewRenderer(r.world, r.cameras[1:], seed=0, spp=SPP, background_spp=BACKGROUND_SPP, color=True)
    rgb = colour.keys(T_S)
    assert rgb.shape == (1, HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(gray_of(rgb[0]), key[1], atol=2e-3)  # smoothing at other pixels
    mask = r.object_masks(T_S)[1]
    np.testing.assert_allclose(gray_of(rgb[0])[mask], key[1][mask], rtol=1e-5, atol=1e-6)
    assert np.abs(rgb[..., 0] - rgb[..., 2]).mean() > 0.01


def test_speeds_are_those_of_warped_points_and_shadows(r):
    mask, speed = r.object_masks(T_S)[1], r.speeds(T_S)[1]
    _, ids, flow = (a[1] for a in r.geometry(T_S, 1e-4))
    exact = maximum_filter(np.linalg.norm(flow, axis=-1) / 1e-4, 7)
    inner = erode(mask, np.ones((9, 9)))
    np.testing.assert_allclose(speed[inner], exact[inner], rtol=0.02, atol=20)
    assert (ids[mask] > 0).all() and (ids[~mask] == 0).all() and ids.max() <= len(r.world.object_names)
    assert (speed[~r.traced(T_S)[1]] == 0).all()
    if "body" in r.world.instances:  # on the flat road the car's shadow is no faster than the car's fastest point
        shadow = r.traced(T_S)[1] & (maximum_filter(mask, 9) == 0)
        assert 0.3 * np.median(speed[mask]) < np.median(speed[shadow]) < 1.5 * np.median(speed[mask])


@one_world
def test_whole_frames_are_the_exact_way(r, full):
    exact = MultiViewRenderer(r.world, r.cameras[1:], seed=0, spp=SPP, background_spp=SPP, whole_frames=True)
    arrays = exact.key_arrays(226, KeyPlan(400, 20_000, 0.5, (1,)))
    assert np.array_equal(arrays["values0"], full[1].ravel()) and (arrays["given0"] == 255).all()


@one_world
def test_fine_keys_give_fast_pixels_and_the_rest_is_close(r, tmp_path):
    """Dense keys from a plan against images rendered at their ticks: small errors, and none where keys are given."""
    plan, store, shares = KeyPlan(40, 20_000, 0.05, (20, 4, 2, 1)), KeyStore(tmp_path), []
    store.set_static(r.static)
    for tick in (0, 4, 8, 10, 11, 12, 14, 16, 20, 40):  # all that the three below need; the disc turns steadily
        store.put(tick, r.key_arrays(tick, plan))
    clip = store.instants(1, plan)
    for tick in (11, 14, 16):
        exact, traced = r.keys(tick / 20_000)[1], r.traced(tick / 20_000)[1]
        given, values = store.given(tick, 1)
        shares.append(given.sum() / traced.sum())
        assert (traced | ~given).all()
        assert np.array_equal(clip.keys[tick][given], exact[given]) and np.array_equal(values, exact[given])
        error = np.abs(clip.keys[tick] - exact) / np.maximum(exact, 0.02)
        assert error[traced].mean() < 0.004 and error[~traced].mean() < 0.001
    assert min(shares) < 0.4 and max(shares) > 0.9  # fine ticks give the rim, coarser ones more


@one_world
def test_ticks_with_fast_motion_are_rendered_inside_the_tick(r):
    """At 500 Hz the disc turns by 4 px a tick: the rendered mean is nearer to a fine mean than that of two keys is."""
    arrays = r.key_arrays(5, KeyPlan(10, 500, 0.2, (1,), sub_ticks=4))
    given = np.flatnonzero(np.unpackbits(arrays["mean_given0"], count=WIDTH * HEIGHT))
    truth = np.mean([r._traced_at(given, (5 + (k + 0.5) / 6) / 500) for k in range(6)], axis=0)
    two = (r._traced_at(given, 5 / 500) + r._traced_at(given, 6 / 500)) / 2
    assert len(given) > 0.1 * WIDTH * HEIGHT
    assert np.abs(arrays["mean_values0"] - truth).mean() < 0.35 * np.abs(two - truth).mean()


# ---------------------------------------------------------------- surfaces that deform


def two_flaps() -> WorldScene:
    """Return the car's street with two square flaps over it that tilt in opposite senses, as one mesh of two bodies."""
    base = world("car")
    square = np.array([(-0.8, -0.8, 0), (0.8, -0.8, 0), (0.8, 0.8, 0), (-0.8, 0.8, 0)])
    mesh = merge([quad((0, 0, 0), (1, 0, 0), (0, 1, 0))] * 2)

    def vertices(t_s: float) -> np.ndarray:
        flaps = []
        for x, turn in ((-1.2, 60 * t_s), (1.2, -60 * t_s)):
            flaps.append(square @ rotation("x", turn)[:3, :3].T + (x, 1.0 + 20 * t_s, 1.2))
        return np.concatenate(flaps)

    bodies = np.repeat([0, 1], len(mesh.faces) // 2)
    flaps = Deforming(Part(replace(mesh, smooth=False), Material((0.7, 0.5, 0.2))), vertices, bodies)
    return replace(base, groups={}, instances={}, poses=lambda t: {}, deforming={"flap": flaps})


def test_deforming_surfaces_have_masks_numbers_and_flow():
    flaps = two_flaps()
    (camera,) = cameras(flaps, 2 * WIDTH, 2 * HEIGHT, (4,))
    r = MultiViewRenderer(flaps, [camera], seed=0, spp=16, background_spp=64)
    assert r.world.object_names == ("flap/0", "flap/1")
    depth, ids, flow = (a[0] for a in r.geometry(T_S, 1e-3))
    before, after = (flaps.moving_points(t) for t in (T_S, T_S + 1e-3))
    for body in (0, 1):
        corners, later = (camera.project(p[4 * body : 4 * body + 4])[0] for p in (before, after))
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        inside = Path(corners).contains_points(np.stack([x.ravel(), y.ravel()], 1)).reshape(ids.shape)
        assert (inside != (ids == body + 1)).mean() < 0.001  # pixel centres on the very edge
        middle = np.unravel_index(
            np.argmin((x - corners[:, 0].mean()) ** 2 + (y - corners[:, 1].mean()) ** 2), ids.shape
        )
        homography, _ = cv2.findHomography(corners, later)  # exact for a plane at both times
        there = homography @ (x[middle], y[middle], 1)
        np.testing.assert_allclose(flow[middle], there[:2] / there[2] - (x[middle], y[middle]), atol=0.01)
    points = camera.unproject(np.stack([x[ids > 0], y[ids > 0]], 1), depth[ids > 0].astype(np.float64))
    normal = np.cross(before[1] - before[0], before[3] - before[0])
    first = points[ids[ids > 0] == 1]
    assert np.abs((first - before[0]) @ (normal / np.linalg.norm(normal))).max() < 1e-3


def hail(camera: Camera, width_px: float) -> tuple[WorldScene, Callable[[float], np.ndarray]]:
    """Return the car's street with 80 balls of a width that fall, as one mesh, and their centres at a time."""
    rng = np.random.default_rng(0)
    uv, z = rng.uniform(5, (WIDTH - 5, HEIGHT - 12), (80, 2)), rng.uniform(2.0, 3.0, 80)
    balls = [ellipsoid([width_px / 2 * d / camera.fx] * 3, segments=8) for d in z]
    mesh, (owner, bodies) = merge(balls), owners(balls)

    def centres(t_s: float) -> np.ndarray:
        return camera.unproject(uv, z) - [0, 0, 9.0 * (t_s - T_S)]

    surface = Deforming(Part(mesh, Material((0.9, 0.9, 0.9))), lambda t: mesh.vertices + centres(t)[owner], bodies)
    return replace(world("car"), groups={}, instances={}, poses=lambda t: {}, deforming={"ball": surface}), centres


def test_bodies_between_the_centres_of_pixels_are_traced():
    """Rays through pixel centres miss most balls half a pixel wide, which are part of the image all the same."""
    (camera,) = cameras(world("car"), WIDTH, HEIGHT, (4,))
    falling, centres = hail(camera, 0.5)
    r = MultiViewRenderer(falling, [camera], seed=0, spp=16, background_spp=16)
    (uv, _), (later, _) = (camera.project(centres(t)) for t in (T_S, T_S + 1e-5))
    column, row = uv.astype(int).T
    assert r.object_masks(T_S)[0][row, column].mean() < 0.5
    assert r.traced(T_S)[0][row, column].all()
    own = np.linalg.norm(later - uv, axis=1) / 1e-5
    assert (r.speeds(T_S)[0][row, column] > 0.99 * own).all() and r.speeds(T_S).max() < 1.01 * own.max()
    for wide in (hail(camera, 2.0)[0], two_flaps()):  # centres find these: nothing is added
        assert not len(narrow_corners(wide, [camera], T_S, T_S + 1e-5)[0])


@pytest.mark.parametrize(("spp", "background_spp"), [(24, 64), (0, 64), (32, 16), (16, 48)])
def test_sample_counts_that_are_refused(spp, background_spp):
    with pytest.raises(UserError, match="spp"):
        MultiViewRenderer(
            world("car"), cameras(world("car"), 8, 5, (4,)), seed=0, spp=spp, background_spp=background_spp
        )


def test_cameras_of_two_sizes_are_refused():
    both = [*cameras(world("car"), 8, 5, (4,)), *cameras(world("car"), 16, 10, (4,))]
    with pytest.raises(UserError, match="resolution"):
        MultiViewRenderer(world("car"), both, seed=0, spp=16, background_spp=16)


@one_world
def test_a_reference_takes_any_seed(r, monkeypatch):
    monkeypatch.setattr(r, "_seed", 2**100)
    assert np.isfinite(r.reference_frames(T_S, 1)).all()
