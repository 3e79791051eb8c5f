"""The slow twin of `sensor.model`: float64, one tick and one step after the other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64, Int32
from spike4dgs.benchmark.spikes.sensor_model import THRESHOLD, charge_after_spike, charge_of_tick
from spike4dgs.generators.sensor.model import DEVIATE_SD, MOST_CHARGE, Keys, Sensor
from spike4dgs.generators.sensor.uneven_kernels import READ_SALT, wave

_GAUSS = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)  # two-point Gauss-Legendre nodes of [0, 1]: exact for cubics


def _exact(image: Float32) -> Float64:
    return np.asarray(image, dtype=np.float64)


def hermite(p1: Float64, p2: Float64, slope1: Float64, slope2: Float64, length: float, x: float) -> Float64:
    """Return the cubic through p1 at x = 0 and p2 at x = length with these slopes per tick, at x."""
    u = x / length
    h00, h10 = (1 + 2 * u) * (1 - u) ** 2, u * (1 - u) ** 2
    h01, h11 = u * u * (3 - 2 * u), u * u * (u - 1)
    return h00 * p1 + h10 * length * slope1 + h01 * p2 + h11 * length * slope2


def tick_means(keys: Keys, key_ticks: Sequence[int], n_ticks: int) -> Iterator[Float64]:
    """Yield mean radiance [H, W] of ticks 0 .. n_ticks - 1: Catmull-Rom through the keys, clamped to the next two."""
    last = len(key_ticks) - 1

    def slope(k: int) -> Float64:
        a, b = max(k - 1, 0), min(k + 1, last)
        return (_exact(keys[b]) - _exact(keys[a])) / (key_ticks[b] - key_ticks[a])

    for k in range(last):
        start, length = key_ticks[k], key_ticks[k + 1] - key_ticks[k]
        if start >= n_ticks:
            return
        p1, p2 = _exact(keys[k]), _exact(keys[k + 1])
        slope1, slope2 = slope(k), slope(k + 1)
        for tick in range(start, min(start + length, n_ticks)):
            a, b = (hermite(p1, p2, slope1, slope2, length, tick - start + x) for x in _GAUSS)
            yield np.clip((a + b) / 2, np.minimum(p1, p2), np.maximum(p1, p2))


def fire(
    means: Iterator[Float64], sensor: Sensor, charge: Int32, before: Float32 | None = None
) -> Iterator[tuple[NDArray[np.bool_], Float64]]:
    """Yield spikes [H, W] of each tick and the charge before the reset, from mean radiances and the initial charge.

    `before`: radiance in which pixels with dead ticks came to their initial charge; None: all are awake.
    """
    sd = sensor.spent_sd
    height, width = charge.shape
    pixels = np.arange(height * width, dtype=np.uint64).reshape(height, width)[::-1]  # as the file numbers them
    level = charge / THRESHOLD
    gain = 1.0 if sensor.gain is None else _exact(sensor.gain)
    dark = 0.0 if sensor.dark is None else _exact(sensor.dark)
    rest, most = np.zeros(charge.shape), MOST_CHARGE if sensor.dead_ticks else 1  # rest: dead ticks that are left
    if sensor.dead_ticks and before is not None:  # an interval has a rest, then ticks that gather
        light = gain * sensor.radiance_gain * _exact(before)
        ticks = 1 / np.maximum(charge_of_tick(light, dark, most + sensor.most_over), 1e-30)
        ago = level * (sensor.dead_ticks + ticks)  # since the rest began
        rest = np.maximum(sensor.dead_ticks - ago, 0)
        level = np.maximum(ago - sensor.dead_ticks, 0) / ticks
    for tick, mean in enumerate(means):
        awake = np.maximum(1 - rest, 0.0)  # share of the tick
        added = charge_of_tick(gain * sensor.radiance_gain * mean, dark, most + sensor.most_over)
        level = level + awake * added
        shown = level
        if sensor.read_noise:
            shown = level + sensor.read_noise * deviates(pixels, tick, sensor.noise_key, READ_SALT)
        fired = (awake > 0) & (shown >= 1.0)
        yield fired, shown
        ago = np.clip((shown - 1) / np.maximum(added, 1e-30), 0, awake)  # ticks since the charge crossed the threshold
        lost = added * np.minimum(ago, sensor.dead_ticks)
        spent = 1 + sd * deviates(pixels, tick, sensor.noise_key) - sensor.clock_ripple * wave(ago) + lost
        level = np.where(fired, charge_after_spike(level, spent), level)
        rest = np.where(fired, np.maximum(sensor.dead_ticks - ago, 0), np.maximum(rest - 1, 0))


def deviates(pixels: NDArray[np.uint64], tick: int, key: int, salt: int = 0) -> Float64:
    """Return the simulator's random numbers of a tick, mean 0 and variance 1: four bytes of a 32-bit hash, summed.

    `salt` chooses other numbers: 0 for the charge that a spike takes, READ_SALT for the comparator.
    """

    def mixed(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
        for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B), (16, 1)):
            x = ((x ^ (x >> np.uint64(shift))) * np.uint64(factor)) & np.uint64(0xFFFFFFFF)
        return x

    hashed = ((pixels * np.uint64(0x9E3779B1)) & np.uint64(0xFFFFFFFF)) ^ np.uint64(salt)
    x = mixed(hashed ^ mixed(np.array([tick ^ key], dtype=np.uint64)))
    total = sum((x >> np.uint64(shift)) & np.uint64(255) for shift in (0, 8, 16, 24))
    return (np.asarray(total, dtype=np.float64) - 510) / DEVIATE_SD


def simulate_reference(
    keys: Keys, key_ticks: Sequence[int], n_ticks: int, sensor: Sensor, charge: Int32, means: bool = False
) -> NDArray[np.bool_]:
    """Return spikes [n_ticks, H, W], upright and unpacked; the arguments are those of `sensor.model.simulate`."""
    light = map(_exact, keys) if means else tick_means(keys, key_ticks, n_ticks)
    return np.stack([fired for fired, _ in fire(light, sensor, charge, keys[0])])
