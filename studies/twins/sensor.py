"""The spike camera: charge as 32-bit integers, light between keys in float32, against float64 tick by tick."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.spikes.stream import count_bits
from spike4dgs.generators.sensor.calibration import dark_map, gain_map
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate
from spike4dgs.studies.speed.simulate import exact_counts, pattern, simulate_numpy
from spike4dgs.studies.speed.timing import by_turns_ms
from spike4dgs.studies.speed_error.measurement import (
    MEDIAN_MS,
    MS,
    Column,
    Measurement,
    Point,
    Request,
    Series,
)

SPACING = 10  # ticks between keys


def light(seed: int, height: int, width: int, n_keys: int) -> dict[str, Float32]:
    """Return keys [K, H, W] by name: usual light, and the light that an integrator has least room for."""
    drift = pattern(height, width, n_keys, 1.0)
    rng = np.random.default_rng(seed)
    flicker = rng.random((n_keys, height, width), dtype=np.float32) ** 4
    return {
        "a drifting pattern": drift,
        "half of it static": pattern(height, width, n_keys, 0.5),
        "almost dark, 0.001": np.asarray(1e-3 * drift, np.float32),
        "glaring, 10 x white": np.asarray(10 * drift, np.float32),
        "other light at every key": flicker,
    }


def _sensor(request: Request) -> Iterator[Series]:
    height, width, ticks = request.pick((12, 20, 200), (125, 200, 1000), (250, 400, 4000))
    n_keys = -(-ticks // SPACING) + 1
    key_ticks = np.arange(n_keys, dtype=np.int64) * SPACING
    sensor = Sensor(gain=gain_map(height, width, 0, "cam_00"), dark=dark_map(height, width, 0, "cam_00"))
    charge = random_charge(height, width, [request.seed])
    for name, keys in light(request.seed, height, width, n_keys).items():

        def by_numpy(keys: Float32 = keys) -> NDArray[Any]:
            return np.concatenate(list(simulate_numpy(keys, key_ticks, ticks, sensor, charge)))

        def ours(threads: int, keys: Float32 = keys) -> NDArray[Any]:
            return np.concatenate(list(simulate(keys, key_ticks.tolist(), ticks, sensor, charge, threads=threads)))

        calls: dict[str, Callable[[], NDArray[Any]]] = {
            "numpy, float32": by_numpy,
            "kernel, 1 thread": partial(ours, 1),
            "kernel, 2 threads": partial(ours, 2),
        }
        start = time.perf_counter()
        exact = exact_counts(keys, key_ticks, ticks, sensor, charge)
        spent = 1e3 * (time.perf_counter() - start)
        none = {"off": 0.0, "most": 0.0, "drift": 0.0}
        points = [Point("float64, tick by tick", {"ms": spent, "median_ms": spent, **none}, "exact")]
        for (title, call), (best, median) in zip(
            calls.items(), by_turns_ms(list(calls.values()), request.pick(1, 3, 7)), strict=True
        ):
            off = np.abs(count_bits(call(), height * width).astype(np.int64) - exact)
            errors = {"off": 100 * float((off > 0).mean()), "most": float(off.max()), "drift": float(off.mean())}
            role: Any = "chosen" if title.endswith("2 threads") else ""
            points.append(Point(title, {"ms": best, "median_ms": median, **errors}, role))
        yield Series(f"{name}, {ticks} ticks of {width}x{height}", tuple(points))


SENSOR = Measurement(
    id="sensor",
    group="Sensor and rendering",
    title="Sensor: integration of light",
    approximation="Charge is a 32-bit integer; light between keys is a cubic in float32, static light is in float64.",
    exact="The same model in float64, one tick after the other (`generators/sensor/reference.py`).",
    reason="Adding integers loses nothing however long the clip, so that a count is off by one spike at most. Sums in "
    "float32, as plain numpy has them, put more counts off by one.",
    columns=(
        MS,
        MEDIAN_MS,
        Column("off", "pixels whose count is off, %"),
        Column("most", "largest difference, spikes", log=False),
        Column("drift", "mean difference, spikes"),
    ),
    x="ms",
    y=("off",),
    run=_sensor,
    seconds={"tiny": 3, "quick": 30, "whole": 300},
    held_by="tests/generators/sensor",
)
