"""The sensor model."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from llvmlite.binding import get_host_cpu_features
from numba import types

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.spikes.sensor_model import THRESHOLD
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.generators.sensor import kernels
from spike4dgs.generators.sensor.calibration import dark_map, gain_map, write_maps
from spike4dgs.generators.sensor.kernels import integrate
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate
from spike4dgs.generators.sensor.reference import fire, simulate_reference, tick_means

TICKS = 100_000


class Lazy:
    """Keys computed on demand: no code may need them all at once."""

    def __init__(self, n, image):
        self.n, self.image = n, image

    def __len__(self):
        return self.n

    def __getitem__(self, k):
        return self.image(k)


def stream(keys, ticks, n, sensor, charge, threads=1):
    packed = np.concatenate(list(simulate(keys, ticks, n, sensor, charge, threads=threads)))
    return SpikeStream(packed, charge.shape[1], charge.shape[0], 20000.0)


def maps(height, width, on):
    return Sensor(0.6, gain_map(height, width, 1, "cam_00"), dark_map(height, width, 1, "cam_00")) if on else Sensor()


def checkpoints(s):
    """Return cumulative counts [H, W] at 1000, 51000 and 100000 ticks."""
    return {1000: s.counts(0, 1000), 51_000: s.counts(0, 51_000)} | {
        TICKS: s.counts(0, 51_000).astype(int) + s.counts(51_000, TICKS)
    }


@pytest.mark.parametrize("on", [False, True])
def test_constant_light_has_no_drift(on):
    light = np.linspace(0, 2.2, 9 * 15, dtype=np.float32).reshape(9, 15)  # up to saturation
    sensor, charge = maps(9, 15, on), random_charge(9, 15, [3])
    gain, dark = (1.0, 0.0) if not on else (sensor.gain.astype(float), sensor.dark.astype(float))
    rate = np.clip(0.6 * gain * light.astype(float) + dark, 0, 1)
    s = stream(Lazy(101, lambda k: light), np.arange(101) * 1000, TICKS, sensor, charge)
    for n, counts in checkpoints(s).items():
        exact = charge / THRESHOLD + n * rate
        # integers only add their own rounding, 2^-31 a tick: 5e-5 after 10^5 ticks
        assert (counts <= np.floor(exact + 1e-9)).all()
        assert (counts >= np.floor(exact - n * 2.0**-31 - 1e-9)).all()


@pytest.mark.parametrize("spacing", [8, 100])
def test_linear_light_has_no_drift(spacing):
    rng = np.random.default_rng(0)
    first, last = rng.random((2, 9, 15)) * 1.5
    sensor, charge = maps(9, 15, True), random_charge(9, 15, [3])
    n_keys = TICKS // spacing + 1

    def light(k):
        return (first + (last - first) * (k / (n_keys - 1))).astype(np.float32)

    s = stream(Lazy(n_keys, light), np.arange(n_keys) * spacing, TICKS, sensor, charge)
    for n, counts in checkpoints(s).items():
        mean = first + (last - first) * (n / 2 / TICKS)
        exact = charge / THRESHOLD + n * (0.6 * sensor.gain * mean + sensor.dark)
        assert np.abs(counts - np.floor(exact)).max() <= 1
        assert (counts == np.floor(exact)).mean() > 0.95


def near_threshold(keys, ticks, n, sensor, charge, tolerance=1e-4):
    """Return [n, H, W]: where the exact charge lies so near the threshold that rounding may decide."""
    levels = (level for _, level in fire(tick_means(keys, ticks, n), sensor, charge))
    return np.stack([np.abs((level + 0.5) % 1 - 0.5) < tolerance for level in levels])


def strays(spikes, expected):
    """Return [n, H, W]: where a pixel's spike count first differs from the twin's; returning to it is no new error."""
    ahead = np.cumsum(spikes.astype(int) - expected, axis=0)
    return (ahead != 0) & (np.concatenate([0 * ahead[:1], ahead[:-1]]) == 0)


@settings(max_examples=30, deadline=None)
@example(height=6, width=7, gaps=[1, 10, 24], cut=0, contrast=1.0, on=False, seed=654)  # a spike one tick early
@given(
    height=st.integers(1, 17),
    width=st.integers(1, 23),
    gaps=st.lists(st.integers(1, 24), min_size=1, max_size=8),
    cut=st.integers(0, 5),
    contrast=st.sampled_from([0.0, 0.01, 1.0, 30.0]),
    on=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_equals_the_twin(height, width, gaps, cut, contrast, on, seed):
    rng = np.random.default_rng(seed)
    ticks = np.cumsum([0, *gaps])
    n = max(1, int(ticks[-1]) - cut)
    keys = (0.5 + contrast * rng.random((len(ticks), height, width))).astype(np.float32)
    constant = rng.random((height, width)) < 0.5
    keys[:, constant] = keys[0, constant]
    sensor, charge = maps(height, width, on), random_charge(height, width, [seed])
    got = stream(keys, ticks, n, sensor, charge)
    expected = simulate_reference(keys, ticks, n, sensor, charge)
    differ = got.window(0, n) != expected
    assert differ.mean() <= 0.01
    assert not (strays(got.window(0, n), expected) & ~near_threshold(keys, ticks, n, sensor, charge)).any()
    assert np.abs(got.counts(0, n).astype(int) - expected.sum(0)).max() <= 1
    if not differ.any():
        assert np.array_equal(got.packed, pack(expected))


def scene(seed=0, height=31, width=45, n_keys=60):
    keys = np.random.default_rng(seed).random((n_keys, height, width), dtype=np.float32)
    keys[:, :, :20] = keys[0, :, :20]
    return keys, np.arange(n_keys) * 5, (n_keys - 1) * 5


SHOT = {"photons": 5e4, "noise_seed": (3,)}


@pytest.mark.parametrize(
    "options", [{}, SHOT, SHOT | {"read_noise": 0.02, "dead_ticks": 1}], ids=["even", "shot noise", "uneven spikes"]
)
def test_bytes_depend_on_the_seed_and_not_on_threads_or_batches(monkeypatch, options):
    keys, ticks, n = scene()
    sensor, charge = replace(maps(31, 45, True), **options), random_charge(31, 45, [0, 7])
    once = stream(keys, ticks, n, sensor, charge, threads=1).packed
    assert np.array_equal(once, stream(keys, ticks, n, sensor, charge, threads=2).packed)
    monkeypatch.setattr("spike4dgs.generators.sensor.model._BATCH_BYTES", 4 * 31 * 45 * 7)
    assert len(list(simulate(keys, ticks, n, sensor, charge))) > 5
    assert np.array_equal(once, stream(keys, ticks, n, sensor, charge, threads=3).packed)
    other = random_charge(31, 45, [1, 7])
    assert not np.array_equal(once, stream(keys, ticks, n, sensor, other).packed)
    other = replace(sensor, noise_seed=(4,))
    assert np.array_equal(once, stream(keys, ticks, n, other, charge).packed) == (not options)
    assert np.array_equal(charge, random_charge(31, 45, [0, 7]))  # the caller's array is not changed


def test_padding_bits_are_zero():
    keys, ticks, n = scene(height=7, width=9)  # 63 pixels
    packed = stream(keys * 0 + 5, ticks, n, Sensor(), random_charge(7, 9, [0])).packed
    assert packed.shape == (n, 8)
    assert (packed[:, -1] == 0x7F).all()


def test_two_adjacent_intervals_in_constant_light():
    """Real recordings show two adjacent intervals at 95 % of pixels, because the rest of the charge is kept."""
    light = np.random.default_rng(0).uniform(0.15, 1.4, (40, 60)).astype(np.float32)
    s = stream(np.stack([light, light]), [0, 500], 500, maps(40, 60, True), random_charge(40, 60, [0]))
    spikes = s.window(0, 500).reshape(500, -1)
    isis = [np.unique(np.diff(np.flatnonzero(pixel))) for pixel in spikes.T]
    assert all(i.max() - i.min() <= 1 for i in isis if len(i))
    assert np.mean([len(i) == 2 for i in isis]) >= 0.95


def test_count_variance_is_that_of_an_ideal_integrator():
    """Counts in a window of constant light vary by f(1-f) only, f the fractional part of the expected count."""
    light = np.random.default_rng(0).uniform(0.1, 1.0, (40, 60)).astype(np.float32)
    s = stream(np.stack([light, light]), [0, 4000], 4000, Sensor(), random_charge(40, 60, [0]))
    counts = np.stack([s.counts(a, a + 20) for a in range(0, 4000, 20)]).astype(float)
    f = (0.6 * 20 * light) % 1
    assert np.abs(counts.var(axis=0) - f * (1 - f)).mean() < 0.02


def test_interpolation_meets_keys_and_never_overshoots():
    rng = np.random.default_rng(0)
    keys = rng.random((6, 4, 5))
    ticks = [0, 400, 800, 1200, 1600, 2000]
    means = np.stack(list(tick_means(keys, ticks, 2000)))
    for k in range(5):
        part = means[ticks[k] : ticks[k + 1]]
        assert (part >= np.minimum(keys[k], keys[k + 1]) - 1e-12).all()
        assert (part <= np.maximum(keys[k], keys[k + 1]) + 1e-12).all()
        assert np.abs(part[0] - keys[k]).max() < 0.01  # a tick is 1/400 of the interval
        assert np.abs(part[-1] - keys[k + 1]).max() < 0.01


def test_interpolation_is_exact_for_linear_and_inner_quadratic_light():
    t = np.arange(0, 101, 10.0)
    for curve, integral, inner in (
        (lambda x: 2 + 0.01 * x, lambda x: 2 * x + 0.005 * x**2, slice(0, 100)),
        (lambda x: (x + 50) ** 2 / 1e4, lambda x: (x + 50) ** 3 / 3e4, slice(10, 90)),  # monotone: no clamp acts
    ):
        means = np.array([m[0, 0] for m in tick_means(curve(t)[:, None, None], t.astype(int), 100)])
        exact = np.diff(integral(np.arange(101.0)))
        assert np.allclose(means[inner], exact[inner], rtol=0, atol=1e-12)


def test_saturated_pixels_fire_every_tick_and_recover_at_once():
    keys = np.array([50, 50, 50, 0, 0, 0], np.float32)[:, None, None] * np.ones((1, 8, 8), np.float32)
    s = stream(keys, np.arange(6) * 10, 50, Sensor(), random_charge(8, 8, [0]))
    assert (s.window(0, 20) == 1).all()
    assert (s.window(30, 50) == 0).all()


def test_maps_are_those_of_the_seed_and_the_camera(tmp_path):
    gain = gain_map(250, 400, 0, "cam_00")
    assert np.array_equal(gain, gain_map(250, 400, 0, "cam_00"))
    assert not np.array_equal(gain, gain_map(250, 400, 0, "cam_01"))
    assert not np.array_equal(gain, gain_map(250, 400, 1, "cam_00"))
    for name in ("a.npz", "b.npz"):
        write_maps(tmp_path / name, {"gain": gain, "dark": None})
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert list(np.load(tmp_path / "a.npz")) == ["gain"]


def test_bad_input_is_named():
    keys, ticks, n = scene()
    charge = random_charge(31, 45, [0])
    for bad_ticks, bad_n in ((ticks[:-1], n), (ticks + 1, n), (ticks, n + 1), (ticks * 0, n)):
        with pytest.raises(UserError, match=r"key frames: expected .*; correct"):
            list(simulate(keys, bad_ticks, bad_n, Sensor(), charge))
    with pytest.raises(UserError, match="gain map"):
        list(simulate(keys, ticks, n, Sensor(gain=np.ones((2, 2), np.float32)), charge))
    for value in (np.nan, np.inf, -np.inf):
        keys[7, 3, 5] = value
        with pytest.raises(UserError, match="key frame 7: expected finite radiance"):
            list(simulate(keys, ticks, n, Sensor(), charge))


@pytest.mark.parametrize("shape", [(64, 40), (60, 64)])
def test_keys_of_another_shape_are_refused(shape):
    keys = [np.zeros((40, 64), np.float32), np.zeros(shape, np.float32)]
    with pytest.raises(UserError, match=r"key frame 1: expected \[H, W\] = \(40, 64\), found \(6"):
        list(simulate(keys, [0, 20], 20, Sensor(), random_charge(40, 64, [0])))


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 6), st.integers(1, 40), st.sampled_from([100.0, 5e3, 5e4]), st.booleans(), st.integers(0, 2**31))
def test_shot_noise_is_the_twins(height, width, photons, on, seed):
    rng = np.random.default_rng(seed)
    ticks = np.cumsum([0, *rng.integers(1, 9, 12)])
    keys = rng.uniform(0, 2.2, (13, height, width)).astype(np.float32)  # up to saturation
    sensor = replace(maps(height, width, on), photons=photons, noise_seed=(seed,))
    charge = random_charge(height, width, [seed])
    n = int(ticks[-1]) - 1
    s = stream(keys, ticks, n, sensor, charge, threads=1)
    exact = simulate_reference(keys, ticks.tolist(), n, sensor, charge)
    assert np.array_equal(s.packed, stream(keys, ticks, n, sensor, charge, threads=3).packed)
    spikes = s.window(0, n)
    assert np.abs(spikes.sum(0).astype(int) - exact.sum(0)).max() <= 1
    # a pixel leaves the twin only where rounding may decide; from there on its random numbers are other ones
    differ = spikes != exact
    first = differ & (np.cumsum(differ, axis=0) == 1)
    assert not (first & ~near_threshold(keys, ticks, n, sensor, charge)).any()
    assert differ.mean() < 0.02


def test_intervals_vary_as_photons_do():
    """Against a plain simulation that draws a Poisson number of photons in every tick."""
    n, photons, rate = 10_000, 400, 0.11
    shape, rng = (20, 30), np.random.default_rng(0)
    light = np.full(shape, rate / 0.6, np.float32)
    charge = random_charge(*shape, [5])
    sensor = Sensor(photons=photons, noise_seed=(5,))
    ours = stream([light, light], [0, n], n, sensor, charge).window(0, n)
    level, plain = charge / THRESHOLD * photons, np.empty((n, *shape), bool)
    for tick in range(n):
        level = level + rng.poisson(rate * photons, shape)
        plain[tick] = level >= photons
        level -= photons * plain[tick]

    def spread(spikes: np.ndarray, lag: int) -> tuple[float, float]:
        """Return mean and variance of the time over `lag` intervals, over all pixels."""
        times = [np.flatnonzero(spikes[:, y, x]) for y in range(shape[0]) for x in range(shape[1])]
        spans = np.concatenate([t[lag:] - t[:-lag] for t in times])
        return float(spans.mean()), float(spans.var())

    for lag in (1, 4, 16):
        (mean, variance), (plain_mean, plain_variance) = spread(ours, lag), spread(plain, lag)
        assert mean == pytest.approx(plain_mean, rel=1e-3) == pytest.approx(lag / rate, rel=2e-3)
        assert variance == pytest.approx(plain_variance, rel=0.05)
        tick = 1 / 6  # of reading out at whole ticks: the variance of the difference of two uniform numbers
        assert variance - tick == pytest.approx(lag / photons / rate**2, rel=0.10)


def test_a_full_well_stays_full_with_noise():
    light = np.full((4, 16), 5.0, np.float32)
    moving = np.stack([light, light + 1, light])  # the other kernel
    for keys, ticks in (([light, light], [0, 3000]), (moving, [0, 1500, 3000])):
        for photons in (None, 100, 5e4):
            sensor = Sensor(photons=photons, noise_seed=(1,))
            s = stream(keys, ticks, 3000, sensor, random_charge(4, 16, [0]))
            assert (s.counts(1, 3000) == 2999).all()


def test_tick_means_are_taken_as_they_are():
    rng = np.random.default_rng(0)
    means = rng.uniform(0, 1.5, (70, 5, 13)).astype(np.float32)
    charge = random_charge(5, 13, [0])
    for sensor in (maps(5, 13, True), replace(maps(5, 13, True), photons=5e4)):
        packed = np.concatenate(list(simulate(means, range(70), 70, sensor, charge, means=True)))
        spikes = SpikeStream(packed, 13, 5, 20000.0).window(0, 70)
        assert np.array_equal(spikes, simulate_reference(means, range(70), 70, sensor, charge, means=True))
    with pytest.raises(UserError, match="mean of every tick"):
        next(simulate(means[:35], range(0, 70, 2), 70, Sensor(), charge, means=True))
    with pytest.raises(UserError, match="photons per spike"):
        next(simulate(means, range(70), 69, Sensor(photons=10), charge))


_SCRIPT = """
import hashlib
import numpy as np
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate

rng = np.random.default_rng(5)
height, width = 20, 70
base = rng.random((height, width), np.float32)
keys = [np.clip(base + 0.1 * k * (rng.random((height, width), np.float32) - 0.3), 0, 1.6) for k in range(9)]
for key in keys:
    key[:5] = base[:5]  # light that does not change
gain = 0.9 + 0.2 * rng.random((height, width), np.float32)
dark = 0.005 * rng.random((height, width), np.float32)
charge = random_charge(height, width, [1, 2])
for sensor in (Sensor(), Sensor(gain=gain, dark=dark, photons=50000.0, noise_seed=(3,))):
    for ticks, means in (([0, 10, 20, 37, 40, 60, 80, 81, 200], False), (range(9), True)):
        spikes = np.concatenate([*simulate(keys, list(ticks), 9 if means else 200, sensor, charge, means=means)])
        print(hashlib.sha256(spikes).hexdigest())
"""
_CODE = """
from spike4dgs.generators.sensor.kernels import integrate
print("".join(integrate.inspect_asm().values()))
"""


def test_an_old_processor_gives_the_same_spikes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    umath = np._core._multiarray_umath  # type: ignore[attr-defined]
    there = [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__[name]]
    environment = {
        "NUMBA_CACHE_DIR": str(tmp_path),
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "NPY_DISABLE_CPU_FEATURES": " ".join(there),
        "OPENBLAS_CORETYPE": "Nehalem",
    }
    command = [sys.executable, "-c", _SCRIPT + _CODE]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    *old, assembly = done.stdout.split("\n", 4)
    exec(_SCRIPT, {})
    here = capsys.readouterr().out.split()
    assert len(here) == 4 and here == old and len(set(here)) == 4
    assert not [name for name in ("zmm", "ymm", "vfmadd") if name in assembly]
    if not get_host_cpu_features().get("avx2"):
        pytest.skip("this processor has no wide registers: both runs used the same instructions")


def test_multiplications_and_additions_are_not_fused() -> None:
    """Of one kernel anew, as code that comes from the cache cannot be read; the options are those of all."""
    every = [kernel for kernel in vars(kernels).values() if hasattr(kernel, "targetoptions")]
    assert integrate in every and all(kernel.targetoptions == integrate.targetoptions for kernel in every)
    along = numba.jit(**integrate.targetoptions)(kernels._along.py_func)
    along.compile((types.float32[::1], types.int64, types.float32))
    (assembly,) = along.inspect_asm().values()
    assert "mulss" in assembly and "vfmadd" not in assembly


def uneven(height, width, **options):
    return replace(maps(height, width, True), **SHOT, **options)


def test_the_loop_for_uneven_spikes_gives_the_bits_of_the_fast_one_where_both_effects_are_off(monkeypatch):
    keys, ticks, n = scene()
    sensor, charge = uneven(31, 45, reset_noise=0.003), random_charge(31, 45, [0, 7])
    fast = stream(keys * 2, ticks, n, sensor, charge).packed
    monkeypatch.setattr(Sensor, "is_uneven", True)
    assert np.array_equal(fast, stream(keys * 2, ticks, n, sensor, charge, threads=2).packed)


@settings(max_examples=15, deadline=None)
@given(
    read=st.sampled_from([0.0, 0.003, 0.05]),
    dead=st.sampled_from([0, 0.4, 1, 2.5]),
    reset=st.sampled_from([0.0, 0.01]),
    ripple=st.sampled_from([0.0, 0.01]),
    bright=st.sampled_from([0.3, 3.0, 12.0]),
    seed=st.integers(0, 2**31),
)
def test_uneven_spikes_equal_the_twins(read, dead, reset, ripple, bright, seed):
    rng = np.random.default_rng(seed)
    keys = (bright * rng.random((6, 7, 13))).astype(np.float32)
    keys[:, :, :4] = keys[0, :, :4]
    ticks, n = np.arange(6) * 15, 71
    sensor = uneven(7, 13, read_noise=read, dead_ticks=dead, reset_noise=reset, clock_ripple=ripple)
    charge = random_charge(7, 13, [seed])
    got = stream(keys, ticks, n, sensor, charge).window(0, n)
    expected = simulate_reference(keys, ticks, n, sensor, charge)
    # steps of `deviate` are whole charge units and increments float32: a spike may move by a tick, seldom more
    assert (got != expected).mean() < 0.01
    assert np.abs(got.sum(0) - expected.sum(0).astype(int)).max() <= 1


def steady_spikes(rate, n, sensor, pixels=4000):
    light = np.full((1, pixels), rate / sensor.radiance_gain, np.float32)
    return stream([light, light], [0, n], n, sensor, random_charge(1, pixels, [5])).window(0, n)[:, 0]


@pytest.mark.parametrize(("rate", "dead"), [(0.05, 1), (0.4, 1), (1.0, 1), (3.0, 1), (0.3, 2), (0.7, 0.5)])
def test_dead_ticks_add_to_every_interval(rate, dead):
    """The law of a real camera's calibration: light is proportional to 1 / (interval - dead ticks)."""
    spikes = steady_spikes(rate, 2000, Sensor(dead_ticks=dead))
    times = np.flatnonzero(spikes[:, 0])
    intervals = np.diff(times)
    mean = (times[-1] - times[0]) / (len(times) - 1)
    assert 1 / (mean - dead) == pytest.approx(rate, rel=0.01)
    assert intervals.max() - intervals.min() <= 1  # the rest of the charge is kept, as time
    assert spikes.mean() == pytest.approx(rate / (1 + rate * dead), rel=0.002)


@pytest.mark.parametrize(("radiance", "dead"), [(0.6, 1), (0.2, 2), (0.6, 10), (3.0, 0.5), (0.0, 3)])
def test_a_clip_with_dead_ticks_begins_in_steady_light(radiance, dead):
    """Pixels begin in all phases of rest and gathering: no tick of the clip is brighter than another."""
    light, sensor = np.full((80, 250), radiance, np.float32), Sensor(dead_ticks=dead)
    s = stream([light, light], [0, 60], 60, sensor, random_charge(80, 250, [3]))
    rate = 0.6 * radiance / (1 + dead * 0.6 * radiance)
    ticks = np.array([s.counts(t, t + 1).mean() for t in range(60)])
    assert ticks == pytest.approx(rate, abs=5 * np.sqrt(rate * (1 - rate) / light.size))
    assert ticks[:40].mean() == pytest.approx(rate, rel=0.005)


@pytest.mark.parametrize(("n", "ripple"), [(3, 0.01), (5, 0.004), (5, 0.01)])
def test_a_ripple_locks_pixels_to_whole_intervals_and_leaves_the_mean_rate(n, ripple):
    """Pixels whose charge takes 1 / x ticks lock where |1 / x - n| < ripple / x: no phase is pushed farther back."""
    intervals = np.linspace(n - 0.5, n + 0.5, 1201)
    light = (1 / intervals / 0.6)[None].astype(np.float32)
    ticks, sensor = 3000, Sensor(clock_ripple=ripple)
    spikes = stream([light, light], [0, ticks], ticks, sensor, random_charge(1, light.size, [5])).window(1000, ticks)
    times = [np.flatnonzero(pixel) for pixel in spikes[:, 0].T]
    locked = np.array([(np.diff(own) == n).all() for own in times])
    assert locked.mean() == pytest.approx(2 * ripple * n, rel=0.1)  # of one whole tick of intervals
    found = np.array([(own[-1] - own[0]) / (len(own) - 1) for own in times])
    assert np.median(np.abs(found - intervals)) < ripple * n / 3  # elsewhere the law of light stays
    assert found.mean() == pytest.approx(intervals.mean(), rel=1e-3)


def interval_variances(sensor, rate=0.1, n=8000):
    """Return the variance of the sum of 1, 4 and 16 intervals, in units of the squared mean interval."""
    found = {k: [] for k in (1, 4, 16)}
    for pixel in steady_spikes(rate, n, sensor, pixels=300).T:
        times = np.flatnonzero(pixel) * rate
        for k, values in found.items():
            values.extend(times[k:] - times[:-k] - k)
    return {k: np.var(values) for k, values in found.items()}


def test_reset_noise_adds_up_from_spike_to_spike_and_read_noise_does_not():
    """k intervals vary by k s^2 for the noise s of a reset, as for shot noise, and by 2 s^2 for that of the comparator.

    Ticks round a time by up to half of one, with the same variance in all three cameras where noise spreads the phase;
    so the noise is nearly as large as the charge of a tick.
    """
    s = 0.08
    reset, shot = interval_variances(Sensor(reset_noise=s)), interval_variances(Sensor(photons=s**-2))
    read = interval_variances(Sensor(read_noise=s))
    rounding = 2 * 0.1**2 / 12  # of both ends
    for k in (1, 4, 16):
        assert reset[k] == pytest.approx(shot[k], rel=0.05)
        assert reset[k] == pytest.approx(k * s * s + rounding, rel=0.06)
    assert read[4] == pytest.approx(read[1], rel=0.05) and read[16] == pytest.approx(read[1], rel=0.05)
    # the first tick in which charge and error exceed the threshold: earlier and less spread than a lone comparison
    assert 0.5 * s * s < read[1] < 2 * s * s + rounding
