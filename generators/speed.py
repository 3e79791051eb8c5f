"""`speed simulate`: the spike simulator beside a plain vectorised numpy integrate-and-fire, with the errors."""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.spikes import UInt8, count_bits, pack
from spike4dgs.generators import sensor as camera
from spike4dgs.generators.sensor import Float32, Int32, Keys, Sensor, random_charge
from spike4dgs.generators.sensor_kernels import THRESHOLD
from spike4dgs.generators.sensor_maps import dark_map, gain_map
from spike4dgs.generators.sensor_reference import fire, tick_means

COLUMNS = ("simulator", "threads", "ms", "million_pixel_ticks_per_s", "ratio", "max_count_error", "pixels_off_percent")


def simulate_numpy(
    keys: Keys, ticks: NDArray[np.int64], n_ticks: int, sensor: Sensor, charge: Int32
) -> Iterator[UInt8]:
    """The same model in plain numpy, float32, whole pictures at a time: what one writes first. Yields packed ticks."""
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
    """Spikes per pixel of the float64 twin, flat, in file order (rows bottom-up)."""
    total = np.zeros(charge.shape, dtype=np.int64)
    for fired, _ in fire(tick_means(keys, ticks.tolist(), n_ticks), sensor, charge):
        total += fired
    return total[::-1].ravel()


def pattern(height: int, width: int, n_keys: int, moving: float) -> Float32:
    """Keys [K, H, W]: a smooth pattern, drifting in the left `moving` share of the picture, still in the rest."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    shift = np.where(x < moving * width, 0.5, 0.0) * np.arange(n_keys)[:, None, None]
    light = 0.45 + 0.4 * np.sin((x - shift) / 5) * np.cos(y / 7)
    return np.asarray(light, dtype=np.float32)


def simulate(argv: Sequence[str] = ()) -> int:
    """Print pixel-ticks per second of the simulator on one and two threads and of plain numpy, each with its errors."""
    p = argparse.ArgumentParser("spike4dgs speed simulate", description=simulate.__doc__)
    p.add_argument("--width", type=int, default=400)
    p.add_argument("--height", type=int, default=250)
    p.add_argument("--ticks", type=int, default=1000)
    p.add_argument("--spacing", type=int, default=10, help="ticks between key frames")
    p.add_argument("--moving", type=float, default=1.0, help="share of the picture that moves")
    p.add_argument("--repeats", type=int, default=5, help="the best of so many runs counts (numpy: of one)")
    p.add_argument("--csv", type=Path, help="write the table here too")
    a = p.parse_args(list(argv))
    n_keys = -(-a.ticks // a.spacing) + 1
    keys, ticks = pattern(a.height, a.width, n_keys, a.moving), np.arange(n_keys, dtype=np.int64) * a.spacing
    pixels = (a.height, a.width, 0, "cam_00")
    sensor, charge = Sensor(gain=gain_map(*pixels), dark=dark_map(*pixels)), random_charge(a.height, a.width, [0])
    clip = (keys, ticks, a.ticks, sensor, charge)
    exact = exact_counts(*clip)
    runs: list[tuple[str, str, int, Callable[[], Iterator[UInt8]]]] = [
        ("numpy, float32", "1", 1, lambda: simulate_numpy(*clip)),
        ("spike4dgs", "1", a.repeats, lambda: camera.simulate(*clip, threads=1)),
        ("spike4dgs", "2", a.repeats, lambda: camera.simulate(*clip, threads=2)),
        (
            "spike4dgs, maps off",
            "2",
            a.repeats,
            lambda: camera.simulate(keys, ticks, a.ticks, Sensor(), charge, threads=2),
        ),
    ]
    exact_off = exact_counts(keys, ticks, a.ticks, Sensor(), charge)
    rows: list[dict[str, str]] = []
    slowest = 0.0
    for name, threads, repeats, run in runs:
        seconds, packed = _best(run, repeats)
        slowest = slowest or seconds
        off = np.abs(count_bits(packed, a.height * a.width).astype(np.int64) - (exact_off if "off" in name else exact))
        speed = a.height * a.width * a.ticks / seconds / 1e6
        values = (name, threads, f"{seconds * 1e3:.1f}", f"{speed:.0f}", f"{slowest / seconds:.1f}")
        errors = (f"{off.max()}", f"{(off > 0).mean() * 100:.4f}")
        rows.append(dict(zip(COLUMNS, values + errors, strict=True)))
    _show(rows, f"{a.ticks} ticks of {a.width}x{a.height}, a key every {a.spacing} ticks; errors against float64")
    if a.csv:
        with atomic_path(a.csv) as part, open(part, "w", newline="") as f:
            writer = csv.DictWriter(f, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
    return 0


def _best(run: Callable[[], Iterator[UInt8]], repeats: int) -> tuple[float, UInt8]:
    """Shortest wall time of the runs, after one that is not counted (compilation), and the last run's packed rows."""
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        chunks = list(run())
        times.append(time.perf_counter() - start)
    return min(times[1:]), np.concatenate(chunks)


def _show(rows: list[dict[str, str]], title: str) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, box=None)
    for column in COLUMNS:
        table.add_column(column.replace("_", " "), justify="left" if column == "simulator" else "right")
    for row in rows:
        table.add_row(*row.values())
    Console(width=120).print(table)
