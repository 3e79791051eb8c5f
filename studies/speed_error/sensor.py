"""The spike camera: charge as 32-bit integers, light between keys in float32, against float64 tick by tick."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Int32, UInt8
from spike4dgs.benchmark.spikes.sensor_model import THRESHOLD
from spike4dgs.benchmark.spikes.stream import count_bits, pack
from spike4dgs.generators.sensor.calibration import dark_map, gain_map
from spike4dgs.generators.sensor.model import Keys, Sensor, random_charge, simulate
from spike4dgs.generators.sensor.reference import fire, tick_means
from spike4dgs.studies.kit.measurement import TIMES, Column, Request, Series, compared, measurement

SPACING = 10  # ticks between keys
COLUMNS = (
    *TIMES,
    Column("off", "pixels whose count is off, %"),
    Column("most", "largest difference, spikes", log=False),
    Column("drift", "mean difference, spikes"),
)


def simulate_numpy(
    keys: Keys, ticks: NDArray[np.int64], n_ticks: int, sensor: Sensor, charge: Int32
) -> Iterator[UInt8]:
    """Yield packed ticks of the same model in plain NumPy: float32, whole images at a time, the obvious program."""
    level = (charge / THRESHOLD).astype(np.float32)
    gain = np.float32(sensor.radiance_gain) * (np.float32(1) if sensor.gain is None else sensor.gain)
    dark = np.float32(0) if sensor.dark is None else sensor.dark
    last = len(ticks) - 1
    for k in range(last):
        p0, p1, p2, p3 = (keys[min(max(k + i, 0), last)] for i in (-1, 0, 1, 2))
        low, high = np.minimum(p1, p2), np.maximum(p1, p2)
        for tick in range(ticks[k], min(ticks[k + 1], n_ticks)):
            u = np.float32((tick + 0.5 - ticks[k]) / (ticks[k + 1] - ticks[k]))
            mean = p1 + u / 2 * (p2 - p0 + u * (2 * p0 - 5 * p1 + 4 * p2 - p3 + u * (3 * (p1 - p2) + p3 - p0)))
            level += np.clip(gain * np.clip(mean, low, high) + dark, 0, 1)
            fired = level >= 1
            level -= fired
            yield pack(fired[None])


def exact_counts(
    keys: Keys, ticks: NDArray[np.int64], n_ticks: int, sensor: Sensor, charge: Int32
) -> NDArray[np.int64]:
    """Return the spikes per pixel of the float64 twin, flat, in file order (rows bottom-up)."""
    total = np.zeros(charge.shape, dtype=np.int64)
    for fired, _ in fire(tick_means(keys, ticks.tolist(), n_ticks), sensor, charge):
        total += fired
    return total[::-1].ravel()


def pattern(height: int, width: int, n_keys: int, moving: float) -> Float32:
    """Return keys [K, H, W]: a smooth pattern, drifting in the left `moving` share of the image, static in the rest."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    shift = np.where(x < moving * width, 0.5, 0.0) * np.arange(n_keys)[:, None, None]
    light = 0.45 + 0.4 * np.sin((x - shift) / 5) * np.cos(y / 7)
    return np.asarray(light, dtype=np.float32)


def light(seed: int, height: int, width: int, n_keys: int) -> dict[str, Float32]:
    """Return keys [K, H, W] by name: usual light, and the light that an integrator has least room for."""
    drift = pattern(height, width, n_keys, 1.0)
    flicker = np.random.default_rng(seed).random((n_keys, height, width), dtype=np.float32) ** 4
    return {
        "a drifting pattern": drift,
        "half of it static": pattern(height, width, n_keys, 0.5),
        "almost dark, 0.001": np.asarray(1e-3 * drift, np.float32),
        "glaring, 10 x white": np.asarray(10 * drift, np.float32),
        "other light at every key": flicker,
    }


def _off(found: NDArray[Any], exact: NDArray[np.int64]) -> dict[str, float]:
    """Return the errors of the counts of packed spikes, or of counts."""
    counts = count_bits(found, exact.size).astype(np.int64) if found.dtype == np.uint8 else found
    off = np.abs(counts - exact)
    return {"off": 100 * float((off > 0).mean()), "most": float(off.max()), "drift": float(off.mean())}


def _numpy(*clip: Any) -> UInt8:
    return np.concatenate(list(simulate_numpy(*clip)))


def _kernel(threads: int, keys: Keys, ticks: NDArray[np.int64], *clip: Any) -> UInt8:
    return np.concatenate(list(simulate(keys, ticks.tolist(), *clip, threads=threads)))


@measurement("sensor", "Sensor and rendering", "Sensor: integration of light", COLUMNS, ("off",))
def integration(request: Request) -> Iterator[Series]:
    """Charge is a 32-bit integer; light between keys is a cubic in float32, static light is in float64.

    The same model in float64, one tick after the other (`generators/sensor/reference.py`).

    Adding integers loses nothing however long the clip, so that a count is off by one spike at most. Sums in float32,
    as plain numpy has them, put more counts off by one.

    tests/generators/sensor
    """
    height, width, ticks = request.pick((12, 20, 200), (125, 200, 1000), (250, 400, 4000))
    n_keys = -(-ticks // SPACING) + 1
    key_ticks = np.arange(n_keys, dtype=np.int64) * SPACING
    sensor = Sensor(gain=gain_map(height, width, 0, "cam_00"), dark=dark_map(height, width, 0, "cam_00"))
    charge = random_charge(height, width, [request.seed])
    for name, keys in light(request.seed, height, width, n_keys).items():
        clip = (keys, key_ticks, ticks, sensor, charge)
        calls: dict[str, Callable[[], Any]] = {
            "float64, tick by tick": partial(exact_counts, *clip),
            "numpy, float32": partial(_numpy, *clip),
            "kernel, 1 thread": partial(_kernel, 1, *clip),
            "kernel, 2 threads": partial(_kernel, 2, *clip),
        }
        title = f"{name}, {ticks} ticks of {width}x{height}"
        yield compared(title, calls, _off, request.pick(1, 3, 7), "kernel, 2 threads", once=True)
