"""Sparse keys: the pixels and ticks that are left out, and the error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.keyframes import KeyStore
from spike4dgs.generators.rendering.render import MultiViewRenderer, StaticViews
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WORLDS

WIDTH, HEIGHT, SPP = 64, 40, 32


@pytest.fixture(scope="module")
def r() -> MultiViewRenderer:
    turntable = WORLDS["turntable"].build(0, 0, 0.02)
    return MultiViewRenderer(turntable, cameras(turntable, WIDTH, HEIGHT, (1, 4)), seed=0, spp=SPP, background_spp=256)


def test_a_renderer_continues_from_the_background_of_another(r):
    plan = KeyPlan(400, 20_000, 0.05, (20, 4, 2))
    first = r
    static = StaticViews.from_arrays(first.static.arrays())
    second = MultiViewRenderer(r.world, first.cameras, seed=0, spp=SPP, background_spp=256, static=static)
    for tick in (200, 202, 204):
        a, b = first.key_arrays(tick, plan), second.key_arrays(tick, plan)
        assert a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)


def test_fine_keys_give_fast_pixels_and_the_rest_is_close(r, tmp_path):
    """Dense keys from a plan against images rendered at every tick: small errors, and none where keys are given."""
    plan = KeyPlan(40, 20_000, 0.05, (20, 4, 2, 1))
    store = KeyStore(tmp_path)
    store.set_static(r.static)
    for tick in range(10, 31):  # the disc turns steadily: one interval and its neighbours are enough
        store.put(tick, r.key_arrays(tick, plan))
    for tick in (0, 40):
        store.put(tick, r.key_arrays(tick, plan))
    for tick in (4, 8, 32, 36):
        store.put(tick, r.key_arrays(tick, plan))
    clip = store.instants(1, plan)
    shares = []
    for tick in (11, 13, 14, 16, 21, 22):
        exact, traced = r.keys(tick / 20_000)[1], r.traced(tick / 20_000)[1]
        given, values = store.given(tick, 1)
        shares.append(given.sum() / traced.sum())
        assert (traced | ~given).all()
        assert np.array_equal(clip.keys[tick][given], exact[given]) and np.array_equal(values, exact[given])
        error = np.abs(clip.keys[tick] - exact) / np.maximum(exact, 0.02)
        assert error[traced].mean() < 0.004 and error[~traced].mean() < 0.001
    assert min(shares) < 0.4 and max(shares) > 0.9  # fine ticks give the rim, coarser ones more


def test_ticks_with_fast_motion_are_rendered_inside_the_tick():
    """A disc that turns by 4 px a tick: the rendered mean is nearer to a fine mean than the mean of two keys is."""
    slow = WORLDS["turntable"].build(0, 0, 0.02)
    spin = replace(slow, poses=lambda t: slow.poses(40 * t))
    r = MultiViewRenderer(spin, cameras(spin, WIDTH, HEIGHT, (4,)), seed=0, spp=64, background_spp=64)
    plan = KeyPlan(20, 20_000, 0.2, (1,), sub_ticks=8)
    arrays = r.key_arrays(7, plan)
    given = np.flatnonzero(np.unpackbits(arrays["mean_given0"], count=WIDTH * HEIGHT))
    truth = np.mean([r._traced_at(given, (7 + (k + 0.5) / 64) / 20_000) for k in range(64)], axis=0)
    two = (r._traced_at(given, 7 / 20_000) + r._traced_at(given, 8 / 20_000)) / 2
    assert len(given) > 0.1 * WIDTH * HEIGHT
    assert np.abs(arrays["mean_values0"] - truth).mean() < 0.35 * np.abs(two - truth).mean()
