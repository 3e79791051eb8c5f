"""Light that varies in time: two layers and a brightness, against Mitsuba's own loop with the lamps that bright."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from built_worlds import built

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.make_dataset import SceneSettings, make_dataset
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.lights.layers import FlashStore, key_store, path_renderer
from spike4dgs.generators.rendering.render import MultiViewRenderer, StaticViews
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds.base import Flash, build_at
from spike4dgs.generators.worlds.hard.flash import WORLD

T_S = 0.0095  # a flash is at its brightest


def test_a_flash_is_rendered_as_by_mitsubas_own_loop():
    world = built("flash", 1)
    views = cameras(world, 64, 40, (4,))
    layered = path_renderer(world, views, seed=0, spp=32, background_spp=32)
    assert world.flash and 0.5 < world.flash.brightness(T_S) < 1
    now = MultiViewRenderer(world.at_brightness(T_S), views, seed=0, spp=32, background_spp=32)
    truth, key = now.reference_frames(T_S, 128), layered.keys(T_S)
    background, _ = layered.static_at(np.arange(2 * 64 * 40))
    backgrounds = np.stack([part.static.background for part in layered._layers])
    assert np.array_equal(background, backgrounds.reshape(-1, 3))
    arrays = layered.key_arrays(190, KeyPlan(400, 20_000, 0.5, (10,)))  # of the same time
    assert set(arrays) == {"given0", "values0", "given1", "values1"}
    steady, flashing = images = gray(backgrounds)
    for v, image in enumerate(images):
        image.ravel()[np.unpackbits(arrays[f"given{v}"]).astype(bool)] = arrays[f"values{v}"]
    np.testing.assert_allclose(key, steady + world.flash.brightness(T_S) * flashing, rtol=1e-5)
    assert abs((key - truth).mean()) < 0.002 and abs((key - truth)[layered.moving_masks(T_S)].mean()) < 0.01
    lit = np.abs(steady - truth) > 0.05
    assert 0.1 < lit.mean() < 0.8 and np.abs(key - truth)[lit].mean() < 0.2 * np.abs(steady - truth)[lit].mean()


def test_radiance_between_keys_has_the_brightness_of_each_tick(tmp_path):
    flash = Flash({}, np.zeros((0, 4)), lambda t_s: float(4e3 * t_s % 2))  # of 0.5 ms: ten ticks
    store, plan = FlashStore(tmp_path, flash), KeyPlan(40, 20_000, 0.5, (20,))
    light = np.float32([[[[0.2] * 3]], [[[0.5] * 3]]])  # one view of one pixel
    store.set_static(StaticViews(light, light))
    for tick in plan.ticks:
        given, values = np.zeros(1, np.uint8), np.zeros(0, np.float32)
        store.put(tick, {"given0": given, "given1": given, "values0": values, "values1": values})
    expected = [0.2 + 0.5 * flash.brightness(tick / 20_000) for tick in range(41)]
    clip, means = store.instants(0, plan), store.view(0, plan)
    assert clip.ticks == list(range(41)) and means.means and len(means.keys) == 40
    np.testing.assert_allclose([clip.keys[tick][0, 0] for tick in range(41)], expected, atol=1e-6)
    assert store.radiance(0, plan, 7)[0, 0] == pytest.approx(expected[7])
    ramp = [0.2 + 0.5 * (0.2 * (tick % 10) + 0.1) for tick in range(40)]  # exact means of a line
    np.testing.assert_allclose([means.keys[tick][0, 0] for tick in range(40)], ramp, atol=1e-6)
    low, high = store.range(0, plan)
    assert low[0, 0] == high[0, 0] == pytest.approx(0.2)  # at coarse keys the flash is off
    assert not isinstance(key_store(tmp_path, built("flash", 1).layers[0]), FlashStore)


def test_lamps_that_are_off_stay_where_they_are():
    world = built("flash", 1)
    assert world.flash
    shade = {"type": "rectangle", "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [2.0, 4.0, 6.0]}}}
    steady, flashing = replace(world, flash=replace(world.flash, emitters={"bulb": shade})).layers
    assert steady.emitters["bulb"] == {"type": "rectangle"} and "emitter" in steady.emitters["lamp"]
    assert flashing.emitters["bulb"] == shade and set(flashing.emitters) == {"bulb", "lamp"}
    assert "emitter" not in flashing.emitters["lamp"] and steady.layers == (steady,)
    half = replace(world, flash=Flash({"bulb": shade}, np.zeros((1, 4)), lambda t_s: 0.5)).at_brightness(0.0)
    assert half.emitters["bulb"]["emitter"]["radiance"]["value"] == [1.0, 2.0, 3.0]
    assert half.emitters["lamp"] == world.emitters["lamp"] and half.at_brightness(0.0) is half
    fast = build_at(WORLD, 0, 1, 0.01, 2.0)
    assert fast.flash and fast.flash.brightness(0.004) == world.flash.brightness(0.008)


def test_split_light_refuses_flashes(tmp_path):
    with pytest.raises(UserError, match="--rendering split: expected a world without mirrors, glass and flashes"):
        make_dataset([SceneSettings("tiny", rendering="split").job("flash")], tmp_path)
