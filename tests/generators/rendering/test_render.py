"""Key frames: traced and reused pixels, and the error of both against a plain full rendering."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from built_worlds import built as world
from matplotlib.path import Path
from scipy.ndimage import binary_erosion as erode
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter
from scipy.stats import norm

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.images import gray as gray_of
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.generators.rendering.render import MultiViewRenderer, make_tracer
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import Deforming, Part, WorldScene
from spike4dgs.generators.worlds.meshes import merge, quad, rotation
from spike4dgs.generators.worlds.surfaces import Material

WIDTH, HEIGHT, SPP = 64, 40, 32
NAMES = ["car", "turntable"]  # rigid; surfaces that deform are in the second half
T_S = 0.0113
NOISE = 0.03  # bound on the mean absolute error


# of tests of what no world changes
one_world = pytest.mark.parametrize("r", ["turntable"], indirect=True)


@pytest.fixture(scope="module", params=NAMES)
def r(request) -> Iterator[MultiViewRenderer]:
    """One renderer at a time for all tests of a world: LLVM recompiles for all scenes in memory."""
    rig = cameras(world(request.param), WIDTH, HEIGHT, (1, 4))
    yield MultiViewRenderer(world(request.param), rig, seed=0, spp=SPP, background_spp=256)
    gc.collect()


@pytest.fixture(scope="module")
def truth(r) -> np.ndarray:
    return r.reference_frames(T_S, 256)


def test_keys_are_the_full_rendering_inside_and_the_background_outside(r):
    key, traced, changed, mask = r.keys(T_S), r.traced(T_S), r.changed(T_S), r.object_masks(T_S)
    assert 0.02 < traced.mean() < 0.6 and (traced <= changed).all() and not changed.all()
    full, (background, same_numbers) = r.crn_frames(T_S), (gray_of(a) for a in r.static.arrays().values())
    assert np.array_equal(key[mask], full[mask])
    shadow = traced & ~mask  # the background and the difference that the shadow makes, from the same random numbers
    assert np.array_equal(key[shadow], np.maximum(full + (background - same_numbers), 0)[shadow])
    assert np.array_equal(key[~changed], r.background[~changed])


def test_keys_are_close_to_mitsubas_own_rendering(r, truth):
    key, traced = r.keys(T_S), r.traced(T_S)
    assert np.isfinite(key).all() and key.min() >= 0 and key.max() < 4
    error = key - truth
    assert np.abs(error).mean() < NOISE
    assert abs(error.mean()) < 0.002
    smooth, plain = (gaussian_filter(e, (0, 2, 2))[~traced] for e in (error, r.background - truth))
    assert np.abs(smooth).mean() < 0.8 * np.abs(plain).mean()  # relighting removes the error above the noise
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


def test_images_move_as_the_geometry(r):
    """Warping one key by depth and pose gives another key: sides, direction of motion and textures all agree."""
    t0, t1 = 0.004, 0.012
    first, second, mask, depth = r.keys(t0)[1], r.keys(t1)[1], r.object_masks(t0)[1], r.depths(t0)[1]
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
def test_a_key_depends_on_the_seed_and_the_time_alone(r):
    together = r
    together.keys(0.002)  # earlier renderings and other views have no influence
    alone = MultiViewRenderer(r.world, together.cameras[1:], seed=0, spp=SPP, background_spp=256)
    mask = alone.object_masks(T_S)[0]
    assert alone.background[0].tobytes() == together.background[1].tobytes()
    assert alone.keys(T_S)[0][mask].tobytes() == together.keys(T_S)[1][mask].tobytes()
    pixels = np.arange(WIDTH * HEIGHT)
    first, again, other = (
        make_tracer(together._scene, together.cameras, seed).trace(pixels, SPP, 0, False) for seed in (0, 0, 1)
    )
    assert first.tobytes() == again.tobytes() != other.tobytes()
    assert abs(first.mean() - other.mean()) < 0.01


@one_world
def test_colour_is_the_same_image(r):
    gray = r
    colour = MultiViewRenderer(r.world, gray.cameras[1:], seed=0, spp=SPP, background_spp=256, color=True)
    rgb = colour.keys(T_S)
    assert rgb.shape == (1, HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(gray_of(rgb[0]), gray.keys(T_S)[1], atol=2e-3)  # smoothing at other pixels
    mask = gray.object_masks(T_S)[1]
    np.testing.assert_allclose(gray_of(rgb[0])[mask], gray.keys(T_S)[1][mask], rtol=1e-5, atol=1e-6)
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
def test_whole_frames_are_the_exact_way(r):
    exact = MultiViewRenderer(r.world, r.cameras[1:], seed=0, spp=SPP, background_spp=SPP, whole_frames=True)
    assert np.array_equal(exact.keys(T_S)[0], r.crn_frames(T_S)[1])
    arrays = exact.key_arrays(200, KeyPlan(400, 20_000, 0.5, (1,)))
    assert np.array_equal(arrays["values0"], exact.keys(0.01).ravel()) and (arrays["given0"] == 255).all()


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


@pytest.mark.parametrize("sigma", [0.2, 0.5, 0.8])
def test_a_blurred_pixels_footprint_is_a_box_and_a_gaussian(sigma):
    if load_mitsuba().variant().startswith("scalar"):
        pytest.skip("the scalar variant has no blur")
    from spike4dgs.generators.rendering.wavefront import footprint_quantiles

    x = footprint_quantiles(sigma)
    assert x == pytest.approx(-x[::-1], abs=1e-6) and (np.diff(x) > 0).all()
    middle = (x[1:] + x[:-1]) / 2
    assert np.mean(middle**2) == pytest.approx(1 / 12 + sigma**2, rel=2e-3)
    inside = np.random.default_rng(0).uniform(-0.5, 0.5, 400_000)
    for edge in (-0.7, 0.0, 0.4, 1.1):  # the response to an edge, by another way
        assert np.mean(middle < edge) == pytest.approx(norm.cdf((edge - inside) / sigma).mean(), abs=2e-3)


def test_a_blur_of_a_number_that_rounded_to_one_is_the_last_quantile():
    if load_mitsuba().variant().startswith("scalar"):
        pytest.skip("the scalar variant has no blur")
    import mitsuba as mi

    from spike4dgs.generators.rendering.wavefront import Views, footprint_quantiles

    views = Views.of(cameras(world("car"), 8, 5, (4,)), 0.5)
    assert np.array(views._blurred(mi.Float(1.0)))[0] == pytest.approx(0.5 + footprint_quantiles(0.5)[-1])


def test_a_blur_is_that_of_the_radiance_and_keeps_its_sum():
    """Against a rendering with four times the pixels along each side, filtered by SciPy."""
    if load_mitsuba().variant().startswith("scalar"):
        pytest.skip("the scalar variant has no blur")
    sigma, fine = 0.6, 4
    w = world("turntable")

    def whole(width, height, spp, **options):
        r = MultiViewRenderer(w, cameras(w, width, height, (4,)), seed=0, spp=spp, background_spp=spp, **options)
        return r.crn_frames(0.0)[0].astype(np.float64)

    blurred, large = whole(64, 40, 256, psf_px=sigma), whole(64 * fine, 40 * fine, 32)
    sharp, expected = (
        image.reshape(40, fine, 64, fine).mean((1, 3))
        for image in (large, gaussian_filter(large, sigma * fine, mode="nearest"))
    )
    inside = np.s_[3:-3, 3:-3]  # beyond the image's edge only the renderer sees
    assert np.abs(sharp - expected)[inside].mean() > 0.01
    assert np.abs(blurred - expected)[inside].mean() < 0.004  # the noise of both
    assert blurred[inside].mean() == pytest.approx(expected[inside].mean(), rel=2e-3)


def test_rays_go_through_the_lens():
    lens = (-0.25, 0.05, 0.002, -0.003, 0.01)
    rig = [cameras(world("car"), 64, 40, (4,))[0], replace(cameras(world("car"), 64, 40, (0,))[0], distortion=lens)]
    renderer = MultiViewRenderer(world("car"), rig, seed=0, spp=1, background_spp=1)
    if load_mitsuba().variant().startswith("scalar"):
        pytest.skip("the scalar variant has no lenses")
    import mitsuba as mi

    v, u = np.mgrid[:40:3, :64:3].reshape(2, -1) + 0.5
    for view, camera in enumerate(rig):
        ray = renderer._tracer._views._ray(mi.UInt32(np.full(len(u), view)), mi.Float(u), mi.Float(v))
        points = camera.unproject(np.stack([u, v], 1), np.ones(len(u))) - camera.center
        expected = points / np.linalg.norm(points, axis=1, keepdims=True)
        assert np.abs(np.array(ray.d).T - expected).max() < 1e-6
