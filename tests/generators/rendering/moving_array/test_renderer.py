"""Keys of an array that moves against Mitsuba's own loop at the pose then, and geometry against the path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from built_worlds import built
from scipy.ndimage import binary_erosion, map_coordinates

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.make_dataset import SceneSettings, make_dataset
from spike4dgs.generators.physics import Physics, PhysicsOptions
from spike4dgs.generators.rendering.image_motion import KeyPlan, key_plan, max_image_speed
from spike4dgs.generators.rendering.moving_array.renderer import MovingArrayRenderer, along
from spike4dgs.generators.rendering.render import MultiViewRenderer
from spike4dgs.generators.rig import array_path, cameras

T_S, DT_S = 0.0113, 0.005
MOVING = Physics(array_motion=2.0, array_rotation=200.0)


@pytest.fixture(scope="module")
def r() -> MovingArrayRenderer:
    world = built("turntable")
    path = array_path(world.rig, MOVING, [0])
    return MovingArrayRenderer(
        world, cameras(world, 64, 40, (1, 4)), path=path, seed=0, spp=32, background_spp=128, color=False
    )


def test_a_key_is_mitsubas_own_rendering_by_cameras_where_they_are_then(r):
    key = r.keys(T_S)
    still = MultiViewRenderer(r.world, r.path.posed(r.cameras, T_S), seed=5, spp=32, background_spp=32)
    truth = still.reference_frames(T_S, 64)
    assert abs((key - truth).mean()) < 0.002 and np.abs(key - truth).mean() < 0.03
    fixed = MultiViewRenderer(r.world, r.cameras, seed=5, spp=32, background_spp=32).reference_frames(T_S, 16)
    assert np.abs(fixed - truth).mean() > 3 * np.abs(key - truth).mean()


def test_an_array_that_looks_away_from_everything_has_keys(r):
    path = array_path(r.world.rig, Physics(array_rotation=1000.0), [0])
    away = MovingArrayRenderer(r.world, r.cameras, path=path, seed=0, spp=1, background_spp=1)
    assert np.isfinite(away.keys(0.2)).all() and np.isfinite(away.speeds(0.2)).all()


def test_two_keys_have_noise_of_their_own_and_a_key_is_the_same_again(r):
    first, other = r.keys(T_S), MovingArrayRenderer(r.world, r.cameras, path=r.path, seed=0, spp=32, background_spp=128)
    assert np.array_equal(first, other.keys(T_S))
    assert len({r._at(t_s)._seed for t_s in (0.0, T_S, T_S + 5e-5)}) == 3


def test_coarse_keys_give_all_pixels_and_fine_ones_those_that_are_fast(r):
    plan = KeyPlan(400, 20_000, 0.5, (20, 5))
    whole, fine = r.key_arrays(220, plan), r.key_arrays(225, plan)
    assert all(np.unpackbits(whole[f"given{v}"]).all() for v in (0, 1)) and len(whole["values0"]) == 64 * 40
    speeds = r.speeds(225 / 20_000)
    for v in (0, 1):
        given = np.unpackbits(fine[f"given{v}"]).astype(bool).reshape(40, 64)
        assert np.array_equal(given, speeds[v] * 0.001 > 0.5) and 0 < given.mean() <= 1
        assert len(fine[f"values{v}"]) == given.sum()


def test_flow_and_depth_carry_one_key_over_to_the_next(r):
    depth, numbers, flow = r.geometry(T_S, DT_S)
    clean = MovingArrayRenderer(r.world, r.cameras, path=r.path, seed=1, spp=64, background_spp=64)
    here, there = (clean.keys(t_s) for t_s in (T_S, T_S + DT_S))
    for v in (0, 1):
        y, x = np.mgrid[:40, :64].astype(float)
        carried = map_coordinates(there[v], [y + flow[v, ..., 1], x + flow[v, ..., 0]], order=1, mode="nearest")
        inner = binary_erosion(numbers[v] == 0, iterations=4)
        error = np.abs(carried - here[v])[inner].mean()
        assert error < 0.5 * np.abs(there[v] - here[v])[inner].mean()
    assert np.isfinite(flow).all() and r.moving_masks(T_S).all() and not r.object_masks(T_S).all()
    assert (depth > 0.3).all()


def test_the_plan_follows_what_the_array_moves(r):
    still, moving = (max_image_speed(r.world, r.cameras, 0.02, path=path) for path in (None, r.path))
    assert moving > still and r.speeds(T_S).max() < 2 * moving
    slow = replace(r.path, speed_m_s=0.0, turn=np.zeros(3))
    assert max_image_speed(r.world, r.cameras, 0.02, path=slow) == pytest.approx(still)
    plans = [key_plan(r.world, r.cameras, 400, 20_000, 0.5, path=path).chain[-1] for path in (None, r.path)]
    assert plans[1] <= plans[0]
    assert along(None) is MultiViewRenderer


@pytest.mark.parametrize(
    ("world", "options", "words"),
    [
        ("car", {"rendering": "split"}, "--rendering split: expected an array that stands still"),
        ("flash", {}, "an array that moves: expected a world in steady light"),
    ],
)
def test_what_cannot_be_rendered_is_one_line(world, options, words, tmp_path):
    with pytest.raises(UserError, match=words) as e:
        settings = SceneSettings(profile="tiny", physics=PhysicsOptions(array_rotation=10.0), **options)
        make_dataset([settings.job(world)], tmp_path)
    assert "\n" not in str(e.value) and not list(tmp_path.iterdir())
