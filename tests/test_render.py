"""Key frames: what is traced, what is reused, and how far both are from a plain full rendering."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.render import MultiViewRenderer, ViewRenderer, _tracer
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WORLDS, WorldScene

WIDTH, HEIGHT, SPP = 64, 40, 32
NAMES = sorted(WORLDS)
T_S = 0.0113
NOISE = {"car": 0.03, "turntable": 0.03}  # bound on the mean absolute error


@cache
def world(name: str) -> WorldScene:
    return WORLDS[name].build(0, 0, 0.02)


@cache
def renderer(name: str) -> MultiViewRenderer:
    """One renderer per world for all tests: LLVM compiles its kernels anew for every scene."""
    rig = cameras(world(name), WIDTH, HEIGHT, (1, 4))
    return MultiViewRenderer(world(name), rig, seed=0, spp=SPP, background_spp=256)


@cache
def reference(name: str) -> np.ndarray:
    return renderer(name).reference_frames(T_S, 1024)


@pytest.mark.parametrize("name", NAMES)
def test_keys_are_the_full_rendering_inside_and_the_background_outside(name):
    r = renderer(name)
    key, traced, changed, mask = r.keys(T_S), r.traced(T_S), r.changed(T_S), r.object_masks(T_S)
    assert 0.02 < traced.mean() < 0.6 and (traced <= changed).all() and not changed.all()
    full, (background, same_numbers) = r.crn_frames(T_S), r._backgrounds
    assert np.array_equal(key[mask], full[mask])
    shadow = traced & ~mask  # the background and the difference that the shadow makes, from the same random numbers
    assert np.array_equal(key[shadow], np.maximum(full + (background - same_numbers), 0)[shadow])
    assert np.array_equal(key[~changed], r.backgrounds()[~changed])


@pytest.mark.parametrize("name", NAMES)
def test_keys_are_close_to_mitsubas_own_rendering(name):
    r = renderer(name)
    key, truth, traced = r.keys(T_S), reference(name), r.traced(T_S)
    assert np.isfinite(key).all() and key.min() >= 0 and key.max() < 4
    error = key - truth
    assert np.abs(error).mean() < NOISE[name]
    assert abs(error.mean()) < 0.002
    smooth, plain = (gaussian_filter(e, (0, 2, 2))[~traced] for e in (error, r.backgrounds() - truth))
    assert np.abs(smooth).mean() < 0.7 * np.abs(plain).mean()  # relighting removes most of the soft change
    assert np.abs(smooth).max() < 0.03


@pytest.mark.parametrize("name", NAMES)
def test_masks_and_depths_belong_together(name):
    r = renderer(name)
    mask, depth = r.object_masks(T_S), r.depths(T_S)
    still = (r._tracer.cast(*r._rays, False)[0]).reshape(r.shape)
    full = (r._tracer.cast(*r._rays, True)[0]).reshape(r.shape)
    assert 0.01 < mask.mean() < 0.5
    assert (full[mask] < still[mask]).all()
    np.testing.assert_array_equal(full[~mask], still[~mask])
    near, far = world(name).depth_range
    assert (depth > near).all() and (depth < far).all()
    assert (r.traced(T_S) | ~mask).all()


@pytest.mark.parametrize("name", NAMES)
def test_what_the_camera_sees_moves_as_the_geometry_says(name):
    """Warping one key by depth and pose gives another key: sides, direction of motion and textures all agree."""
    r, (t0, t1) = renderer(name), (0.004, 0.012)
    first, second, mask, depth = r.keys(t0)[1], r.keys(t1)[1], r.object_masks(t0)[1], r.depths(t0)[1]
    camera = r.cameras[1]
    rows, columns = np.nonzero(mask)
    points = camera.unproject(np.stack([columns + 0.5, rows + 0.5], 1), depth[mask].astype(np.float64))
    main = next(iter(world(name).instances))
    motion = world(name).poses(t1)[main] @ np.linalg.inv(world(name).poses(t0)[main])
    uv, _ = camera.project(points @ motion[:3, :3].T + motion[:3, 3])
    warped = map_coordinates(second, [uv[:, 1] - 0.5, uv[:, 0] - 0.5], order=1, mode="nearest")
    right = np.abs(warped - first[mask]).mean()
    back, _ = camera.project(points @ np.linalg.inv(motion)[:3, :3].T + np.linalg.inv(motion)[:3, 3])
    wrong = np.abs(map_coordinates(second, [back[:, 1] - 0.5, back[:, 0] - 0.5], order=1) - first[mask]).mean()
    assert right < 0.6 * np.abs(second[mask] - first[mask]).mean()
    assert right < 0.5 * wrong


def test_a_key_depends_on_the_seed_and_the_time_alone():
    together = renderer("car")
    together.keys(0.002)  # neither what was rendered before nor the other views leave a trace
    alone = ViewRenderer(world("car"), together.cameras[1], seed=0, spp=SPP, background_spp=256)
    mask = alone.object_mask(T_S)
    assert alone.background().tobytes() == together.backgrounds()[1].tobytes()
    assert alone.key(T_S)[mask].tobytes() == together.keys(T_S)[1][mask].tobytes()
    pixels = np.arange(WIDTH * HEIGHT)
    first, again, other = (
        _tracer(together._scene, together.cameras, seed).trace(pixels, SPP, 0, False) for seed in (0, 0, 1)
    )
    assert first.tobytes() == again.tobytes() != other.tobytes()
    assert abs(first.mean() - other.mean()) < 0.01


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
