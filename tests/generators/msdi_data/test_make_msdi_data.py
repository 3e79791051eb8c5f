"""Training bursts: jittered and wide rigs, rendering, and the command."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.training_bursts import Burst, burst_path, open_folder, write_bursts
from spike4dgs.benchmark.variants import FIRST_TRAINING_VARIANT, HIDDEN_VARIANTS
from spike4dgs.cli.make_msdi_data import make_msdi_data
from spike4dgs.generators.msdi_data.make_msdi_data import MakeBursts
from spike4dgs.generators.msdi_data.rigs import jittered_cameras
from spike4dgs.generators.msdi_data.wide_rigs import layout, wide_cameras
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WORLDS, WorldScene
from spike4dgs.method.msdi.training_data import points_of


@pytest.fixture(scope="module")
def world() -> WorldScene:
    return WORLDS["turntable"].build(0, 13, 0.1)


def test_jittered_rigs_stay_near_the_worlds_own(world: WorldScene) -> None:
    own = cameras(world, 104, 64)
    none = jittered_cameras(world, 104, 64, np.random.default_rng(0), 0.0)
    for a, b in zip(own, none, strict=True):
        np.testing.assert_allclose(a.w2c, b.w2c, atol=1e-9)
        assert a.fx == pytest.approx(b.fx)
    target = np.array(world.rig.target)
    distance = np.linalg.norm(own[4].center - target)
    seen = set()
    for seed in range(20):
        rig = jittered_cameras(world, 104, 64, np.random.default_rng(seed))
        for camera in rig:
            np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
            assert 0.5 * distance < np.linalg.norm(camera.center - target) < 2 * distance
            uv, z = camera.project(target[None])
            assert z[0] > 0 and np.abs(uv[0] - (52, 32)).max() < 80
            assert camera.center[2] > 0
        seen.add(tuple(rig[0].center))
    assert len(seen) == 20


def test_the_widest_pair_of_a_layout_is_one_apart() -> None:
    for seed in range(20):
        places = layout(np.random.default_rng(seed))
        distances = np.linalg.norm(places[:, None] - places[None], axis=-1)
        assert places.shape == (9, 2) and np.isclose(distances.max(), 1)


def test_rigs_have_the_baselines_that_they_should_and_see_the_target(world: WorldScene) -> None:
    shares, focals = [], []
    for seed in range(60):
        rig = wide_cameras(world, 128, 96, np.random.default_rng(seed))
        centers = np.stack([camera.center for camera in rig])
        for camera in rig:
            np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(camera.R) > 0 and camera.center[2] > 0
        middle = centers.mean(axis=0)
        away = np.linalg.norm(middle - np.array(world.rig.target))
        widest = np.linalg.norm(centers[:, None] - centers[None], axis=-1).max()
        shares.append(widest / away)
        focals.append(rig[0].fx)
        # All axes pass within a picture's width of a common point, so that the views overlap.
        aims = np.stack([camera.R[2] for camera in rig])
        common = middle + away * aims.mean(axis=0) / np.linalg.norm(aims.mean(axis=0))
        uv = np.concatenate([camera.project(common[None])[0] for camera in rig])
        assert np.abs(uv - (64, 48)).max() < 128
    assert 0.015 < min(shares) < 0.05 and 0.2 < max(shares) < 0.5
    assert max(focals) > 2.5 * min(focals)


def test_without_an_amount_they_stand_where_the_worlds_own_do(world: WorldScene) -> None:
    rig = wide_cameras(world, 128, 96, np.random.default_rng(0), 0.0)
    middle = np.mean([camera.center for camera in rig], axis=0)
    away = np.linalg.norm(np.array(world.rig.center) - np.array(world.rig.target))
    assert np.linalg.norm(middle - np.array(world.rig.center)) < 0.1 * away


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Burst]:
    folder = tmp_path_factory.mktemp("bursts")
    facts, arrays = MakeBursts(rigs=1, instants=1, resting=2, width=32, height=20, spp=4, seed=0)(("turntable", 14))
    write_bursts(burst_path(folder, "turntable", 14), facts, arrays)
    return folder, open_folder(folder)[0].read(0)


def depth_errors(burst: Burst, pairs: Iterable[tuple[int, int]]) -> np.ndarray:
    """Of the points that one view sees, their depths in another view against that view's own, relative."""
    points, off = points_of(burst.depth, burst.K, burst.w2c), []
    for a, b in pairs:
        K, w2c = burst.K[b], burst.w2c[b]
        camera = Camera("c", 32, 20, K[0, 0], K[1, 1], K[0, 2], K[1, 2], w2c[:3, :3], w2c[:3, 3])
        uv, z = camera.project(points[a].reshape(-1, 3).astype(np.float64))
        inside = np.isfinite(z) & (uv > 0).all(1) & (uv < (32, 20)).all(1)
        column, row = uv[inside].astype(int).T
        off.append(np.abs(burst.depth[b, row, column] / z[inside] - 1))
    return np.concatenate(off)


def test_rendered_depth_agrees_between_views(rendered: tuple[Path, Burst]) -> None:
    assert np.median(depth_errors(rendered[1], [(view, 0) for view in range(1, 9)])) < 0.02


def test_rigs_at_rest_have_one_light_and_exact_depth(rendered: tuple[Path, Burst]) -> None:
    (file,) = open_folder(rendered[0])
    assert len(file) == 3
    for number in (1, 2):
        burst = file.read(number)
        assert not burst.moving.any() and len(burst.keys) == 3
        assert (burst.keys == burst.keys[0]).all() and 0.05 < burst.keys.mean() < 2
        assert np.median(depth_errors(burst, [(0, 1), (4, 5)])) < 0.03


def test_only_moving_pixels_are_stored_twice_and_they_change(rendered: tuple[Path, Burst]) -> None:
    burst = rendered[1]
    assert 0.05 < burst.moving.mean() < 0.6
    change = np.abs(burst.keys[0] - burst.keys[-1])
    assert not change[~burst.moving].any()
    assert change[burst.moving].mean() > 1e-3
    assert np.isfinite(burst.keys).all() and 0.05 < burst.keys.mean() < 2


def test_the_command_keeps_existing_shards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = []

    def fake(self: MakeBursts, chunk: tuple[str, int]):  # type: ignore[no-untyped-def]
        made.append(chunk)
        return self.facts(*chunk), {"still": np.zeros(3, np.float16)}

    monkeypatch.setattr(MakeBursts, "__call__", fake)
    assert make_msdi_data(("car", "bird"), out=tmp_path, variants=1) == 0
    hidden = [(w, v) for v in HIDDEN_VARIANTS for w in ("car", "bird")]
    assert made == [("car", 13), ("bird", 13), *hidden]
    assert "8/8" in capsys.readouterr().out
    made.clear()
    burst_path(tmp_path, "car", 11).unlink()
    assert make_msdi_data(("car",), out=tmp_path, variants=2) == 0
    assert made == [("car", 11), ("car", 14)]
    with pytest.raises(UserError, match="choose another --out"):
        make_msdi_data(("car",), out=tmp_path, variants=1, bursts=MakeBursts(spp=64))


def test_no_variant_that_is_kept_for_tests_is_ever_made() -> None:
    assert 10 <= min(HIDDEN_VARIANTS) <= max(HIDDEN_VARIANTS) < FIRST_TRAINING_VARIANT


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"worlds": ("cart",)}, "expected one of jaywalk, .* found .cart."),
        ({"bursts": MakeBursts(rigs=0)}, "expected counts from 1 up"),
        ({"variants": 8988}, "--variants: expected at most 8987, found 8988; variants from 9000 on are kept"),
        ({"bursts": MakeBursts(instants=2000)}, "--instants: expected at most [0-9]+, the ticks of a clip, found 2000"),
        ({"bursts": MakeBursts(spp=12)}, "--spp: expected a power of two, found 12"),
    ],
)
def test_wrong_arguments_are_named(tmp_path: Path, arguments: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        make_msdi_data(out=tmp_path, **arguments)  # type: ignore[arg-type]
