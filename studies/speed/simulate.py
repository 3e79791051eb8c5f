"""`speed simulate`: the spike simulator beside plain numpy and, where it is installed, spikezoo's; with errors."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Int32, UInt8
from spike4dgs.benchmark.spikes.sensor_model import SENSOR, THRESHOLD
from spike4dgs.benchmark.spikes.stream import count_bits, pack
from spike4dgs.generators.sensor import model as camera
from spike4dgs.generators.sensor.calibration import dark_map, gain_map
from spike4dgs.generators.sensor.model import Keys, Sensor, random_charge
from spike4dgs.generators.sensor.reference import fire, tick_means
from spike4dgs.studies.speed.timing import module_of, show_table, time_ms

COLUMNS = ("simulator", "threads", "ms", "Mpx-ticks/s", "x numpy", "x spikezoo", "largest count error", "pixels off, %")
_SPIKEZOO = "spikezoo video2spike_simulation"


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


@dataclass(frozen=True, eq=False)
class Run:
    """One simulator to time: a call that returns packed spikes, and the exact counts."""

    name: str
    threads: str
    exact: NDArray[np.int64]
    call: Callable[[], UInt8]


def simulate(argv: Sequence[str] = ()) -> int:
    """Time the simulator on one and two threads, plain numpy, and spikezoo; print speeds, ratios and errors.

    spikezoo's function takes one frame for each tick: the frames are made in advance; it models neither maps nor noise.
    """
    p = argparse.ArgumentParser("spike4dgs speed simulate", description=simulate.__doc__)
    p.add_argument("--width", type=int, default=400)
    p.add_argument("--height", type=int, default=250)
    p.add_argument("--ticks", type=int, default=1000)
    p.add_argument("--spacing", type=int, default=10, help="ticks between key frames")
    p.add_argument("--moving", type=float, default=1.0, help="share of the image that moves")
    p.add_argument("--repeats", type=int, default=5, help="number of timed runs, of which the median counts")
    p.add_argument("--csv", type=Path, help="also write the table to this file")
    a = p.parse_args(list(argv))
    n_keys = -(-a.ticks // a.spacing) + 1
    keys, ticks = pattern(a.height, a.width, n_keys, a.moving), np.arange(n_keys, dtype=np.int64) * a.spacing
    timed = []
    for run in (runs := _our_runs(keys, ticks, a.ticks) + (zoo := _spikezoo_runs(keys, ticks, a.ticks))):
        found = count_bits(run.call(), a.height * a.width).astype(np.int64)
        timed.append((time_ms(run.call, a.repeats)[1], np.abs(found - run.exact)))
    numpy_ms, zoo_ms = timed[0][0], timed[-1][0]
    rows = [
        [
            run.name,
            run.threads,
            f"{ms:.1f}",
            f"{a.height * a.width * a.ticks / ms / 1e3:.4g}",
            f"{numpy_ms / ms:.3g}",
            f"{zoo_ms / ms:.3g}" if zoo else "-",
            str(off.max()),
            f"{100 * (off > 0).mean():.3f}",
        ]
        for run, (ms, off) in zip(runs, timed, strict=True)
    ]
    if not zoo:
        rows.append([f"{_SPIKEZOO}: not installed", *["-"] * (len(COLUMNS) - 1)])
    title = f"{a.ticks} ticks of {a.width}x{a.height}, a key every {a.spacing} ticks; errors against float64"
    show_table(title, COLUMNS, rows, a.csv)
    return 0


def _our_runs(keys: Float32, ticks: NDArray[np.int64], n_ticks: int) -> list[Run]:
    """Return plain NumPy first, then the simulator with more and with fewer of its terms."""
    height, width = keys.shape[1:]
    pixels, charge = (height, width, 0, "cam_00"), random_charge(height, width, [0])
    plain, maps = Sensor(), Sensor(gain=gain_map(*pixels), dark=dark_map(*pixels))
    noisy = replace(maps, photons=SENSOR.photons_per_spike)

    def ours(sensor: Sensor, threads: int) -> Callable[[], UInt8]:
        at = ticks.tolist()
        return lambda: np.concatenate(list(camera.simulate(keys, at, n_ticks, sensor, charge, threads=threads)))

    def by_numpy() -> UInt8:
        return np.concatenate(list(simulate_numpy(keys, ticks, n_ticks, maps, charge)))

    exact = {s: exact_counts(keys, ticks, n_ticks, s, charge) for s in (plain, maps, noisy)}
    return [
        Run("numpy, tick by tick, maps", "1", exact[maps], by_numpy),
        Run("spike4dgs, maps and shot noise", "1", exact[noisy], ours(noisy, 1)),
        Run("spike4dgs, maps and shot noise", "2", exact[noisy], ours(noisy, 2)),
        Run("spike4dgs, maps", "2", exact[maps], ours(maps, 2)),
        Run("spike4dgs, neither", "2", exact[plain], ours(plain, 2)),
    ]


def _spikezoo_runs(keys: Float32, ticks: NDArray[np.int64], n_ticks: int) -> list[Run]:
    """Return spikezoo's simulator on ready-made frames, if it is installed.

    It draws its initial charges from NumPy's global generator, which is seeded so that the exact counts are known.
    """
    if (other := _spikezoo()) is None:
        return []
    sensor = Sensor()
    frames = np.stack([m.astype(np.float32) for m in tick_means(keys, ticks.tolist(), n_ticks)])

    def run() -> UInt8:
        np.random.seed(0)  # noqa: NPY002
        return pack(other(frames, 1 / sensor.radiance_gain))

    np.random.seed(0)  # noqa: NPY002
    charge = (np.random.random(keys.shape[1:]) * THRESHOLD).astype(np.int32)  # noqa: NPY002
    return [Run(_SPIKEZOO, "1", exact_counts(keys, ticks, n_ticks, sensor, charge), run)]


def _spikezoo() -> Callable[..., Any] | None:
    """Return spikezoo's simulator, from its one file: importing the package would load its networks."""
    try:
        return getattr(module_of("spikezoo", "utils/spike_utils.py"), "video2spike_simulation", None)
    except ImportError as e:
        print(e)
        return None
