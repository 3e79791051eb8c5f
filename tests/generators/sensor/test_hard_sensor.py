"""Hard inputs of the spike simulator: darkness, saturation, flicker, tiny gains, long clips, seeds and threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hard_case import BYTES, REFUSAL, HardCase, core_counts
from numpy.typing import NDArray

from spike4dgs.benchmark.spikes.sensor_model import THRESHOLD
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.generators.other_sensors import events
from spike4dgs.generators.sensor.calibration import dark_map, gain_map
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate
from spike4dgs.generators.sensor.reference import simulate_reference

_HEIGHT, _WIDTH = 9, 15
_SHAPE = (_HEIGHT, _WIDTH)
_TICKS = 400
_LONG = 100_000  # ticks: 5 s
_PHOTONS = 5e3
Keys = NDArray[np.float32]


def _light(levels: Sequence[float]) -> Keys:
    """Return keys [K, H, W] of even images."""
    return np.array(levels, np.float32)[:, None, None] * np.ones(_SHAPE, np.float32)


def _maps() -> Sensor:
    return Sensor(0.6, gain_map(*_SHAPE, 1, "cam_00"), dark_map(*_SHAPE, 1, "cam_00"))


def _random(low: float, high: float) -> Callable[[np.random.Generator], Keys]:
    return lambda rng: rng.uniform(low, high, (6, *_SHAPE)).astype(np.float32)


def _even(*levels: float) -> Callable[[np.random.Generator], Keys]:
    return lambda rng: _light(levels)


_INPUTS: dict[str, tuple[str, Callable[[np.random.Generator], Keys], Sensor]] = {
    "dark": ("no light at all", _even(*[0.0] * 6), Sensor()),
    "dark-current": ("no light, dark current and pixel gains", _even(*[0.0] * 6), _maps()),
    "saturated": ("radiance 1e6", _even(*[1e6] * 6), Sensor()),
    "at-the-limit": ("exactly one threshold a tick", _even(*[2.0] * 6), Sensor(0.5)),
    "flicker": ("light that jumps between 0 and 50", _even(0, 50, 0, 50, 0, 50), Sensor()),
    "tiny-gain": ("a gain of 1e-7: less than one spike", _random(1, 2), Sensor(1e-7)),
    "huge-gain": ("a gain of 1e7 in light of 1e-7", _random(0, 1e-7), Sensor(1e7)),
    "negative": ("negative radiance, as a renderer's filter makes", _even(-1, 0.5, -1, 0.5, -1, 0.5), Sensor()),
    "noise": ("random light, 5,000 photons a spike", _random(0, 1.5), replace(_maps(), photons=_PHOTONS)),
}


def _simulated(keys: Keys, ticks: Sequence[int], n: int, sensor: Sensor, seed: int, threads: int = 1) -> SpikeStream:
    charge = random_charge(keys.shape[1], keys.shape[2], [seed])
    packed = np.concatenate(list(simulate(keys, ticks, n, sensor, charge, threads=threads)))
    return SpikeStream(packed, keys.shape[2], keys.shape[1], 20_000.0)


def _noisy(seed: int, threads: int = 1, shape: tuple[int, int] = (31, 45)) -> bytes:
    keys = np.random.default_rng(0).random((30, *shape), dtype=np.float32)
    sensor = Sensor(0.6, gain_map(*shape, 1, "c"), dark_map(*shape, 1, "c"), photons=5e4, noise_seed=(seed,))
    return bytes(_simulated(keys, range(0, 150, 5), 145, sensor, seed, threads).packed.tobytes())


@pytest.mark.hard_case(
    twin="one tick and one step after the other, float64", unit="spikes ahead or behind", tolerance=1
)
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.hard_case(asked=f"{i[0]}, {_TICKS} ticks")) for n, i in _INPUTS.items()]
)
def test_sensor(hard_case: HardCase, name: str) -> None:
    _, make, sensor = _INPUTS[name]
    keys = make(hard_case.rng())
    ticks = (np.arange(len(keys)) * (_TICKS // (len(keys) - 1))).tolist()
    noisy = replace(sensor, noise_seed=(hard_case.seed,))
    stream = _simulated(keys, ticks, _TICKS, noisy, hard_case.seed)
    expected = simulate_reference(keys, ticks, _TICKS, noisy, random_charge(*_SHAPE, [hard_case.seed]))
    apart = np.cumsum(stream.window(0, _TICKS).astype(int) - expected, axis=0)
    rate = stream.counts(0, _TICKS) / _TICKS
    moved = np.mean(stream.window(0, _TICKS) != expected)
    text = f"{rate.min():.4g} to {rate.max():.4g} spikes per tick; {moved:.2%} of the spikes a tick early or late"
    hard_case.check(np.abs(apart).max(), text)


@pytest.mark.hard_case(
    asked=f"counts of {_LONG:,} ticks in constant light from dark to saturated",
    twin="the closed form, float64", unit="spikes", tolerance=1,
)  # fmt: skip
def test_drift(hard_case: HardCase) -> None:
    light = np.linspace(0, 2.2, _HEIGHT * _WIDTH, dtype=np.float32).reshape(_SHAPE)
    charge = random_charge(*_SHAPE, [hard_case.seed])
    stream = _simulated(np.stack([light] * 3), [0, _LONG // 2, _LONG], _LONG, Sensor(), hard_case.seed)
    counts = stream.counts(0, 50_000).astype(int) + stream.counts(50_000, _LONG)
    exact = np.floor(charge / THRESHOLD + _LONG * np.clip(0.6 * light.astype(np.float64), 0, 1))
    hard_case.check(np.abs(counts - exact).max(), f"{counts.min()} to {counts.max():,} spikes")


@pytest.mark.hard_case(
    asked="NaN or infinite radiance, a tick twice, 10 photons a spike, a map of another size", **REFUSAL
)
def test_refuse(hard_case: HardCase) -> None:
    good, ticks = _light([0.5] * 3), [0, 5, 10]

    def run(keys: Keys, at: Sequence[int], sensor: Sensor = Sensor()) -> Callable[[], object]:  # noqa: B008
        return lambda: _simulated(keys, at, 10, sensor, 0)

    hard_case.refused(
        {
            "NaN": run(_light([0.5, np.nan, 0.5]), ticks),
            "infinity": run(_light([0.5, np.inf, 0.5]), ticks),
            "minus infinity": run(_light([0.5, -np.inf, 0.5]), ticks),
            "a tick twice": run(good, [0, 10, 10]),
            "keys that end too early": run(good, [0, 4, 8]),
            "10 photons a spike": run(good, ticks, Sensor(photons=10)),
            "a gain map of 2x2": run(good, ticks, Sensor(gain=np.ones((2, 2), np.float32))),
        }
    )


@pytest.mark.hard_case(
    asked="shot noise and pixel maps on 1, 2 ... threads", twin="one thread", **BYTES, kind="threads"
)
def test_threads(hard_case: HardCase) -> None:
    counts = [*core_counts(), core_counts()[-1] + 1]
    hard_case.same_bytes([_noisy(hard_case.seed, n) for n in counts], [f"{n} threads" for n in counts])


@pytest.mark.hard_case(
    asked="shot noise and first charges of one seed, twice", twin="the first of the two", **BYTES, kind="seeds"
)
def test_same_seed(hard_case: HardCase) -> None:
    hard_case.same_bytes([_noisy(hard_case.seed) for _ in range(2)], ["the first run", "the second"])
    assert _noisy(hard_case.seed + 1) != _noisy(hard_case.seed), "another seed gives the same bytes"


@pytest.mark.hard_case(
    asked=f"counts of 5,000 pixels, {_PHOTONS:,.0f} photons a spike, four seeds",
    twin="their standard deviation in closed form", unit="relative", tolerance=0.1, kind="seeds",
)  # fmt: skip
def test_other_seeds(hard_case: HardCase) -> None:
    """The spread of counts is that of sums of independent charges, rounded down from a random start."""
    rate, n = 0.6, _TICKS  # n * rate is whole
    light = np.full((1, 5000), rate / 0.6, np.float32)  # each pixel has random numbers of its own
    counts = []
    for seed in range(hard_case.seed, hard_case.seed + 4):
        sensor = Sensor(photons=_PHOTONS, noise_seed=(seed,))
        counts.append(_simulated(np.stack([light, light]), [0, n], n, sensor, seed).counts(0, n).astype(float).ravel())
    sd = np.sqrt(n * rate / _PHOTONS)
    expected = np.sqrt(sd**2 + _floor_variance(sd))
    spread = np.std(counts, axis=1)
    text = f"standard deviations {', '.join(f'{v:.3f}' for v in spread)} spikes of {np.mean(counts):.1f}"
    hard_case.check(np.abs(spread / expected - 1).max(), text)


def _floor_variance(sd: float) -> float:
    """Return how much rounding down adds to the variance of a normal number on a uniformly random offset: f (1 - f)."""
    x = np.linspace(-6 * sd, 6 * sd, 20_001)
    weight = np.exp(-0.5 * (x / sd) ** 2)
    f = x - np.floor(x)
    return float((weight * f * (1 - f)).sum() / weight.sum())


@pytest.mark.hard_case(
    asked="events of black, of a step by 1e6 up and down, of still light",
    twin="the number of thresholds between the logarithms", unit="events",
)  # fmt: skip
def test_events(hard_case: HardCase) -> None:
    levels = ([0.0, 0.0, 0.0], [1e-3, 1e3, 2e-3], [0.5, 0.5, 0.5])  # by pixel: black, up by 1e6 and down, still
    keys = np.array(levels, np.float32).T[:, None]
    found = events(list(keys), [0, 20, 40], 40, 20_000, threshold=0.2)
    up = int(np.log(1e6) / 0.2)
    expected = [0, up + int(up - np.log(2.0) / 0.2), 0]
    counts = np.bincount(found.x, minlength=3)
    assert (np.diff(found.t) >= 0).all()
    hard_case.check(np.abs(counts - expected).sum(), f"{counts.tolist()} events where {expected} were expected")
