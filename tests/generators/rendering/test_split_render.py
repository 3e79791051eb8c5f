"""Key frames of split light: the same light as whole paths, with less noise that no pixel keeps."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest
from built_worlds import built, forget_scenes

from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.profiles import SPLIT_PROFILES
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.mitsuba_scene import aligned
from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.generators.rendering.split_render import SplitRenderer
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WorldScene
from spike4dgs.generators.worlds.meshes import translation

WIDTH, HEIGHT, SPP, T_S = 64, 40, 32, 0.0113
SOFT = SPLIT_PROFILES["tiny"].soft


def renderer(world: WorldScene, views: tuple[int, ...] = (1, 4), seed: int = 0, **others) -> SplitRenderer:
    rig = cameras(world, WIDTH, HEIGHT, views)
    return SplitRenderer(world, rig, seed=seed, spp=SPP, background_spp=2 * SPP, **{"soft": SOFT, **others})


def leaving(world: WorldScene) -> WorldScene:
    """Return the world with objects that have left all views after a second."""

    def poses(t_s: float) -> dict[str, np.ndarray]:
        return {name: translation(1e4 * (t_s > 1), 0, 0) @ pose for name, pose in world.poses(t_s).items()}

    return replace(world, poses=poses)


# of tests of what no world changes
one_world = pytest.mark.parametrize("r", ["turntable"], indirect=True)


# the sun, coats and chrome; a lamp, coats and brass
@pytest.fixture(scope="module", params=[pytest.param("motor", marks=pytest.mark.slow), "turntable"])
def r(request) -> SplitRenderer:
    """One renderer for most tests of a world: recording the launches of another takes longer than most of them."""
    if load_mitsuba().variant().startswith("scalar"):
        pytest.skip("split light needs a variant that compiles kernels")
    forget_scenes()
    return renderer(leaving(built(request.param, 10)))


@pytest.fixture(scope="module")
def other(r) -> SplitRenderer:
    return renderer(r.world, seed=5)


@pytest.fixture(scope="module")
def whole(r) -> np.ndarray:
    """Whole paths [8, K] of the traced pixels."""
    return radiances(r, np.flatnonzero(r.traced(T_S)), range(8), None)


def radiances(r: SplitRenderer, where: np.ndarray, streams: range, maps: bool | None) -> np.ndarray:
    """Return renderings [streams, K] of SPP samples: whole paths (maps None), split without maps, or with them."""
    known = r._maps_at(T_S) if maps else []
    r._scene.set_time(T_S)
    many, numbers = np.tile(where, len(streams)), np.repeat(streams, len(where))  # of one launch: each takes long
    if maps is None:
        found = r._tracer.trace(many, SPP, numbers, True)
    else:
        found = r._tracer.split(many, SPP, numbers, True, known)
    return gray(found).astype(np.float64).reshape(len(streams), -1)


def test_parts_are_the_path_in_the_mean(r, whole, monkeypatch):
    """Without maps every sample traces its own soft path: an unbiased twin of `trace`."""
    where = np.flatnonzero(r.traced(T_S))
    monkeypatch.setattr(r._tracer, "most_light", 1e30)
    parts = radiances(r, where, range(8), False)
    difference = parts.mean(0) - whole.mean(0)
    error = np.sqrt(np.mean(parts.var(0) + whole.var(0)) / 7 / len(where))
    assert abs(difference.mean()) < 4 * error + 1e-4
    blocks = difference[: len(where) // 16 * 16].reshape(-1, 16).mean(1)
    assert np.abs(blocks).mean() < 0.01 * whole.mean(), "nowhere is a light left out or counted twice"


def test_maps_take_the_noise_and_leave_the_light(r, whole):
    where = np.flatnonzero(mask := r.object_masks(T_S))
    split = radiances(r, where, range(8, 16), True)  # of other random numbers
    paths = whole[:, mask[r.traced(T_S)]]
    assert split.var(0).mean() < 0.4 * paths.var(0).mean()  # chrome is traced
    assert np.median(split.var(0)) < 0.4 * np.median(paths.var(0))  # so is what finds no like surface
    a, b = paths[::2].mean(0), paths[1::2].mean(0)
    square = np.mean((split.mean(0) - a) * (split.mean(0) - b))  # the references' noise is independent
    assert square < 0.009**2, "41 dB where a pixel is as wide as a wheel"
    assert abs(np.mean(split.mean(0) - (a + b) / 2)) < 0.01 * paths.mean()


@one_world
def test_noise_is_new_at_each_key_where_objects_move_and_none_elsewhere(r, other):
    times = (T_S, T_S + 1e-3)
    inside = r.object_masks(times[0]) & r.object_masks(times[1])
    keys, others = ([one.keys(t) for t in times] for one in (r, other))
    first, second = ((a - b).astype(np.float64)[inside] for a, b in zip(keys, others, strict=True))
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.25
    same = ~r.changed(T_S)
    assert same.any() and np.array_equal(keys[0][same], r.background[same])


@one_world
def test_a_key_depends_on_the_seed_and_the_time_alone(r):
    r.keys(0.001)  # earlier renderings have no influence
    again = renderer(r.world, static=r.static)  # as another process has it
    plan = KeyPlan(400, 20_000, 0.25, (20, 10))
    arrays, others = (k.key_arrays(210, plan) for k in (again, r))
    assert arrays.keys() == others.keys() and all(np.array_equal(arrays[k], others[k]) for k in arrays)


@one_world
def test_background_and_truth_of_a_view_do_not_depend_on_other_views(r):
    """But for the soft light of the whole rig, which all its views share."""
    soft = r.static.views([1]).soft
    alone = renderer(r.world, (4,), anchors_s=r._anchor_s, soft_static=soft, maps_of=lambda: r)
    mask = alone.object_masks(T_S)[0]
    assert alone.background[0].tobytes() == r.background[1].tobytes()
    assert alone.keys(T_S)[0][mask].tobytes() == r.keys(T_S)[1][mask].tobytes()


@one_world
def test_kernels_serve_all_lists_of_pixels_and_numbers_of_samples(r):
    """NumPy's memory starts anywhere; a kernel that depends on it is compiled anew for every other key."""
    import drjit as dr

    maps = r._maps_at(T_S)
    room = np.arange(4096)

    def rendered(start: int, count: int, spp: int) -> None:
        r._scene.set_time(T_S + start * 1e-6)
        where = room[start : start + count]
        r._tracer.trace(where, spp, start, True)
        r._tracer.split(where, spp, where + 1, True, maps)
        r._tracer.soft(where, np.full(count, spp), where, True, gloss=False)
        r._tracer.soft(where, spp, where, True, gloss=True)

    rendered(0, 2000, 8)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for start, count, spp in ((1, 200, 8), (6, 37, 16), (11, 301, 4)):
            rendered(start, count, spp)
        launched = [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
    assert launched and all(kernel["cache_hit"] for kernel in launched)


@one_world
def test_garbage_is_collected_before_or_after_a_recording(r, monkeypatch):
    """An array of NumPy's memory that is freed in a recording ends the process: an old renderer's, at any time."""
    import mitsuba as mi

    from spike4dgs.generators.rendering.wavefront import Views  # it needs compiled kernels

    class Old:
        def __init__(self) -> None:
            self.itself, self.array = self, mi.Float(aligned(np.ones(16, np.float32)))

    samples, usual, old = Views.samples, gc.get_threshold(), list[Old]()

    def littering(*arguments, **others):
        old.clear()
        gc.set_threshold(1)
        assert [[] for _ in range(100)], "containers, which the collector counts"
        return samples(*arguments, **others)

    tracer, where, maps = r._make_tracer(0, 0.0), np.arange(40), r._maps_at(T_S)
    r._scene.set_time(T_S)
    monkeypatch.setattr(Views, "samples", littering)
    gc.collect()
    gc.set_threshold(100_000)
    old.append(Old())
    try:
        tracer.split(where, 4, where, True, maps)
    finally:
        gc.set_threshold(*usual)
    assert gc.isenabled()


@one_world
def test_views_share_soft_light_of_the_points_that_they_see(r, other):
    """A point that two views see has half of the paths in each, and together about the noise of one view alone."""
    alone = renderer(r.world, (4,), soft_static=None)
    known = r.soft_static.paths
    assert set(np.unique(known)) <= {4, 8, 16, 32} and (alone.soft_static.paths == SOFT.paths).all()
    halves = known[1] <= SOFT.paths // 2
    assert halves.mean() > 0.3
    other_alone = renderer(r.world, (4,), seed=5)
    together = (r.soft_static.smooth[1] - other.soft_static.smooth[1])[halves, :3]
    single = (alone.soft_static.smooth[0] - other_alone.soft_static.smooth[0])[halves, :3]
    assert np.mean(together**2) < 1.6 * np.mean(single**2)  # fewer strata
    assert abs(np.mean(r.soft_static.smooth[1] - alone.soft_static.smooth[0])) < 0.01


@one_world
def test_each_pixel_has_samples_of_its_own(r):
    """The same as of pixels traced apart, each group with its number; and no pixel knows of others in the list."""
    where = np.flatnonzero(r.traced(T_S))
    near, samples = r._sampling(where, T_S)
    assert len(np.unique(samples)) > 2 and samples.min() >= 4 and samples.max() <= SPP
    assert near[r.object_masks(T_S).ravel()[where]].all()
    values, streams = r._traced_at(where, T_S), np.where(near, 77, 0)
    assert np.array_equal(r._traced_at(where[::3], T_S), values[::3])
    together = r._rgb_at(where, samples, streams, T_S)
    for n in np.unique(samples):
        mine = samples == n
        apart = r._rgb_at(where[mine], int(n), streams[mine], T_S)
        np.testing.assert_allclose(together[mine], apart, rtol=1e-5, atol=1e-6)


@one_world
def test_chosen_numbers_of_samples_leave_the_mean(r, whole, monkeypatch):
    """Pilot samples are thrown away: what they choose cannot lean to bright or to dark."""
    where = np.flatnonzero(r.traced(T_S))
    monkeypatch.setattr(r._tracer, "most_light", 1e30)
    _, samples = r._sampling(where, T_S)
    r._scene.set_time(T_S)
    streams = np.repeat(range(100, 112), len(where))  # of one launch: another takes as long as most of these samples
    chosen = gray(r._tracer.split(np.tile(where, 12), np.tile(samples, 12), streams, True, [])).astype(np.float64)
    chosen = chosen.reshape(12, -1)
    for some in (samples == n for n in np.unique(samples)):
        difference = chosen.mean(0)[some] - whole.mean(0)[some]
        error = np.sqrt(np.mean(chosen.var(0)[some] / 11 + whole.var(0)[some] / 7) / some.sum())
        assert abs(difference.mean()) < 4 * error + 1e-4


@one_world
def test_what_has_left_all_views_leaves_the_background(r):
    assert r.traced(T_S).any() and not r.traced(1.5).any()
    # on one processor a sample of soft light is another where the scene holds more: 9 pixels, off by 8e-6
    assert (found := r.keys(1.5)).shape == r.background.shape and (found != r.background).mean() < 0.01
    np.testing.assert_allclose(found, r.background, rtol=1e-4)
