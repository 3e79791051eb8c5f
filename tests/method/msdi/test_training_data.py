"""MSDI's training data: spikes against their twin and the scenes' simulator, and batches."""

from pathlib import Path

import numpy as np
import pytest
from toy_bursts import toy_burst, write_toy_shard
from toy_world import GAIN, ToyWorld

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.training_bursts import REACH, open_folder
from spike4dgs.benchmark.spikes.bits import unpack
from spike4dgs.benchmark.spikes.sensor_model import THRESHOLD
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate
from spike4dgs.method.msdi import training_data

TICKS = 41
SHAPE = (40, 64)
NO_NOISE = float("inf")


# ---------------------------------------------------------------- spikes


def pixels_of(rates: np.ndarray, photons: float = NO_NOISE, seed: int = 0) -> training_data.Pixels:
    rng = np.random.default_rng(seed)
    shape = rates.shape[1:]
    gain, dark = rng.uniform(0.8, 1.2, shape), rng.uniform(0, 0.02, shape)
    return training_data.Pixels(rates.astype(np.float32), gain.astype(np.float32), dark.astype(np.float32), photons)


def twin(pixels: training_data.Pixels, ticks: int, charge: np.ndarray) -> np.ndarray:
    """Return spikes without noise, one tick after the other, from the definition."""
    level, out = charge.astype(np.float64), []
    at = np.linspace(-REACH, REACH, len(pixels.rates))
    for tick in range(-(ticks // 2), ticks // 2 + 1):
        # the mean of straight lines over a tick, by the trapezoid of its ends: no image lies inside a tick
        ends = [np.apply_along_axis(lambda r, x=x: np.interp(x, at, r), 0, pixels.rates) for x in (tick, tick + 1)]
        level += np.clip(pixels.gain * np.mean(ends, axis=0) + pixels.dark, 0, 1)
        fired = level >= 1
        level = np.minimum(level - fired, 1 - 2.0**-31)
        out.append(fired)
    return np.array(out)


@pytest.mark.parametrize(("ticks", "count"), [(41, 3), (41, 7), (41, 15), (9, 43), (1, 3)])
def test_spikes_equal_their_slow_twin(ticks: int, count: int) -> None:
    """Dark, saturated and changing pixels."""
    rng = np.random.default_rng(count)
    rates = rng.uniform(-0.2, 1.6, (count, 12, 20))
    rates[:, 0], rates[:, 1], rates[:, 2] = 0, 3, 0.4
    pixels, charge = pixels_of(rates), rng.random((12, 20), np.float32)
    found = training_data.fire(pixels, ticks, charge, rng)
    assert found.dtype == np.uint8 and found.shape == (ticks, 12, 20)
    # sums in another order: a spike may come a tick early or late where the charge is 1 to the last bit
    assert np.mean(found != twin(pixels, ticks, charge)) < 1e-3
    assert found[:, 1].all()


def simulated(
    start: np.ndarray, end: np.ndarray, pixels: training_data.Pixels, charge: np.ndarray, photons: float | None
):  # type: ignore[no-untyped-def]
    """Return the simulator's spikes [41, H, W] in light that changes linearly from `start` to `end` in 41 ticks."""
    sensor = Sensor(1.0, pixels.gain, pixels.dark, photons, (7,))
    packed = np.concatenate(list(simulate([start, end], [0, TICKS], TICKS, sensor, charge, threads=1)))
    return unpack(packed, SHAPE[1], SHAPE[0], True)


def test_spikes_equal_the_simulators_without_noise() -> None:
    rng = np.random.default_rng(3)
    first, last = rng.uniform(0, 0.9, (2, *SHAPE)).astype(np.float32)
    middle = (first + last) / 2
    pixels = pixels_of(np.stack([first, middle, last]))
    charge = random_charge(*SHAPE, [5])
    at = [(first + (last - first) * np.float32((tick + REACH) / (2 * REACH))) for tick in (-20, 21)]
    expected = simulated(*at, pixels, charge, None)
    found = training_data.fire(pixels, TICKS, (charge / THRESHOLD).astype(np.float32), rng)
    assert np.mean(found != expected) < 1e-4
    assert expected.mean() > 0.3


@pytest.mark.parametrize("photons", [100.0, 5e4])
def test_spikes_are_distributed_as_the_simulators(photons: float) -> None:
    """Counts and intervals of steady light; with 100 photons a spike, intervals vary by a tenth."""
    light = np.full(SHAPE, 0.31, np.float32)
    ones, none = np.ones(SHAPE, np.float32), np.zeros(SHAPE, np.float32)
    pixels = training_data.Pixels(np.stack([light] * 3), ones, none, photons)
    found = training_data.make_spikes(pixels, TICKS, np.random.default_rng(1))
    expected = simulated(light, light, pixels, random_charge(*SHAPE, [9]), photons)

    def shares(spikes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        flat = spikes.reshape(TICKS, -1)
        intervals = np.concatenate([np.diff(np.flatnonzero(pixel)) for pixel in flat.T])
        return tuple(np.bincount(x, minlength=42) / len(x) for x in (flat.sum(0), intervals))  # type: ignore[return-value]

    for a, b in zip(shares(found), shares(expected), strict=True):
        assert np.abs(a - b).sum() / 2 < 0.04
    assert found.mean() == pytest.approx(expected.mean(), rel=5e-3)
    spread = [shares(s)[1] @ np.arange(42) ** 2 - (shares(s)[1] @ np.arange(42)) ** 2 for s in (found, expected)]
    assert spread[0] == pytest.approx(spread[1], rel=0.06)


def test_windows_that_bursts_do_not_hold_are_refused() -> None:
    training_data.check_ticks(41)
    for ticks in (40, 43, -1):
        with pytest.raises(UserError, match="an odd number of ticks below 42"):
            training_data.check_ticks(ticks)


# ---------------------------------------------------------------- batches


def test_points_project_onto_their_pixels_in_all_views() -> None:
    world = ToyWorld(width=32, height=20)
    burst = toy_burst(world, 0.5)
    burst.depth[0, 0, :3] = np.inf
    points = training_data.points_of(burst.depth, burst.K, burst.w2c)
    assert np.isnan(points[0, 0, :3]).all() and np.isfinite(points[1:]).all()
    for camera, seen in zip(world.cameras[1:], points[1:], strict=True):
        uv, _ = camera.project(seen.reshape(-1, 3).astype(np.float64))
        v, u = np.mgrid[:20, :32] + 0.5
        np.testing.assert_allclose(uv, np.stack([u.ravel(), v.ravel()], 1), atol=2e-3)
    board = points[4][burst.moving[4] & (points[4, ..., 1] < 0.5)]
    assert len(board) and np.abs(board[:, 1]).max() < 1e-3  # the board is at y = 0


def test_a_mirrored_burst_is_a_rig_in_a_mirrored_world() -> None:
    burst = toy_burst(ToyWorld(width=32, height=20), 0.5)
    burst.K[:, 0, 2] += 1.75
    before = training_data.points_of(burst.depth, burst.K, burst.w2c)
    other = training_data.mirrored(burst)
    after = training_data.points_of(other.depth, other.K, other.w2c)
    np.testing.assert_allclose(after[:, :, ::-1] * (-1, 1, 1), before, atol=1e-4)
    np.testing.assert_allclose(np.linalg.det(other.w2c[:, :3, :3]), 1)
    np.testing.assert_array_equal(other.keys[..., ::-1], burst.keys)
    again = training_data.mirrored(other)
    for name in ("keys", "depth", "w2c", "K"):
        np.testing.assert_array_equal(getattr(again, name), getattr(burst, name))


def test_variation_keeps_the_instant() -> None:
    """The middle image stays the true one but for brightness and mirror, and maps stay maps."""
    burst, rng = toy_burst(ToyWorld(width=32, height=20), 0.5), np.random.default_rng(0)
    kinds = set()
    for _ in range(40):
        found = training_data.varied(burst, rng)
        mirror = not np.array_equal(found.depth, burst.depth)
        middle = found.keys[1, ..., ::-1] if mirror else found.keys[1]
        ratio = middle / burst.keys[1]
        assert 0.6 <= ratio.min() <= ratio.max() <= 1.4 and np.ptp(ratio) < 1e-5
        first = found.keys[0, ..., ::-1] if mirror else found.keys[0]
        backwards = np.abs(first / ratio - burst.keys[2]).max() < 1e-5
        assert backwards != (np.abs(first / ratio - burst.keys[0]).max() < 1e-5)
        np.testing.assert_array_equal(np.sort(found.gain, axis=None), np.sort(burst.gain, axis=None))
        kinds.add((mirror, backwards))
    assert len(kinds) == 4


def test_batches_are_a_function_of_their_generator(tmp_path: Path) -> None:
    write_toy_shard(tmp_path, 13)
    write_toy_shard(tmp_path, 14, width=40, height=20)
    data = training_data.Bursts(open_folder(tmp_path))
    assert (len(data), data.views, data.gain) == (4, 9, GAIN)
    sizes = set()
    for seed in range(8):
        one, two = (data.draw(3, 4, 9, np.random.default_rng(seed)) for _ in range(2))
        for name in ("spikes", "rate", "points", "moving", "intrinsics", "w2c"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
        height, width = one.rate.shape[2:]
        sizes.add((height, width))
        assert one.spikes.shape == (3, 4, 9, height, width) and one.points.shape == (3, 4, height, width, 3)
        assert one.rate.min() >= 0 and one.rate.max() <= 1
        np.testing.assert_allclose(one.w2c[:, 0], np.tile(np.eye(4), (3, 1, 1)), atol=1e-12)
        # the points of view 0 lie on the rays of view 0
        back = np.einsum("bij,bhwj->bhwi", one.intrinsics[:, 0], one.points[:, 0])
        np.testing.assert_allclose(back[:, 3, 5, :2] / back[:, 3, 5, 2:], np.tile([5.5, 3.5], (3, 1)), atol=1e-3)
    assert sizes == {(24, 32), (20, 40)}


def test_points_of_a_batch_agree_between_views(tmp_path: Path) -> None:
    """A point that view 1 sees falls, by the batch's own cameras, on a pixel of view 0 with that depth or less."""
    write_toy_shard(tmp_path, 13)
    batch = training_data.Bursts(open_folder(tmp_path)).draw(1, 2, 9, np.random.default_rng(4))
    seen = batch.points[0, 1].reshape(-1, 3)
    pixel = seen @ batch.intrinsics[0, 0].T
    u, v = (pixel[:, :2] / pixel[:, 2:]).T
    inside = (u > 0) & (u < 32) & (v > 0) & (v < 24)
    there = batch.points[0, 0, v[inside].astype(int), u[inside].astype(int), 2]
    ratio = there / seen[inside, 2]
    assert inside.mean() > 0.7
    assert np.mean(np.abs(ratio - 1) < 0.05) > 0.8


def test_fixed_bursts_are_always_the_same(tmp_path: Path) -> None:
    for variant in (10, 11):
        write_toy_shard(tmp_path, variant)
    one, two = (training_data.Bursts(open_folder(tmp_path)).fixed(3, 4, 9) for _ in range(2))
    assert len(one) == 3
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.spikes, b.spikes)
    burst = open_folder(tmp_path)[0].read(0)
    expected = training_data.chosen(burst, np.arange(4)).keys[1] * np.float32(GAIN)
    np.testing.assert_array_equal(one[0].rate[0], np.clip(expected, 0, 1))


def test_files_of_several_sensors_do_not_mix() -> None:
    with pytest.raises(UserError, match="expected files of one radiance gain, found 0 files"):
        training_data.Bursts([])
