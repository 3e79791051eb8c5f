"""Calibration of a camera from recordings that any owner can make: before uniform light, and in the dark.

A pixel's rate is (spikes - 1) / (ticks between the first and the last), which knows nothing of the charge before the
first spike and after the last: over T ticks it is wrong by about 1 / T, where a count is by 1 / (rate T). Then

    gain = (rate before uniform light - dark rate) / its mean,      dark = rate in the dark

`calibrate` does this for a scene and, where the truth is known, says how far off it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional

from spike4dgs.benchmark.bits import kernel, rows
from spike4dgs.benchmark.cameras import Camera
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.scene import Scene, open_scene
from spike4dgs.benchmark.spikes import SpikeStream, SpikeWriter, open_stream
from spike4dgs.generators.sensor import Float32, Sensor, random_charge, simulate
from spike4dgs.generators.sensor_maps import write_maps

FLAT_RADIANCE = 0.7
FLAT_TICKS = 500  # 25 ms
DARK_TICKS = 2000  # 100 ms: the darkest hundredth of the pixels fires every 670 ticks


@dataclass(frozen=True, eq=False)
class Calibration:
    """What a camera does to light, as far as its recordings tell.

    Attributes:
        gain: [H, W], relative sensitivity, mean 1.
        dark: [H, W], spikes per tick in the dark.
        radiance_gain: spikes per tick of a pixel of gain 1 that sees radiance 1, without the dark rate.
    """

    gain: Float32
    dark: Float32
    radiance_gain: float


def write_calibration(folder: Path, camera: Camera, sensor: Sensor, entropy: Sequence[int]) -> None:
    """Record folder/flat/CAM.dat and folder/dark/CAM.dat with a simulated camera. `entropy`: of the initial charges."""
    for name, radiance, n_ticks in (("flat", FLAT_RADIANCE, FLAT_TICKS), ("dark", 0.0, DARK_TICKS)):
        keys = [np.full((camera.height, camera.width), radiance, np.float32)] * 2
        charge = random_charge(camera.height, camera.width, [*entropy, *name.encode()])
        noise = (*sensor.noise_seed, *name.encode())
        same = Sensor(sensor.radiance_gain, sensor.gain, sensor.dark, sensor.photons, noise)
        with SpikeWriter(folder / name / f"{camera.id}.dat", camera.width, camera.height) as writer:
            for packed in simulate(keys, [0, n_ticks], n_ticks, same, charge):
                writer.write(packed)


def estimate(flat: SpikeStream, dark: SpikeStream, flat_radiance: float) -> Calibration:
    """Gain and dark maps from a recording before uniform light of radiance `flat_radiance`, and one in the dark.

    Raises UserError where the recordings do not fit together, or where no pixel sees the light.
    """
    if (flat.width, flat.height) != (dark.width, dark.height) or flat_radiance <= 0:
        found = f"{flat.width}x{flat.height}, {dark.width}x{dark.height} and radiance {flat_radiance:g}"
        raise problem("calibration", "two recordings of one size and a positive radiance", found, "correct them")
    dark_rate = rates(dark)
    light = np.maximum(rates(flat) - dark_rate, 0)
    if not (mean := float(light.mean())) > 0:
        raise problem("flat-field recording", "light", "no more spikes than in the dark", "record it again")
    return Calibration((light / mean).astype(np.float32), dark_rate.astype(np.float32), mean / flat_radiance)


def rates(stream: SpikeStream) -> NDArray[np.float64]:
    """Spikes per tick [H, W] of steady light; a pixel without spikes counts as having half of one."""
    n = stream.width * stream.height
    first, last, count = np.full(n, -1, np.int64), np.full(n, -1, np.int64), np.zeros(n, np.int64)
    first_and_last(rows(stream.packed), first, last, count)
    span = np.maximum(last - first, 1)
    flat = np.where(count > 1, (count - 1) / span, np.maximum(count, 0.5) / stream.n_ticks)
    image = flat.reshape(stream.height, stream.width)
    return np.asarray(image[::-1] if stream.rows_bottom_up else image)


@kernel
def first_and_last(packed: Any, first: Any, last: Any, count: Any) -> None:
    """Tick of the first and last spike and number of spikes of every pixel [P], from packed rows [T, bytes]."""
    for tick in range(len(packed)):
        for byte in range(packed.shape[1]):
            bits = packed[tick, byte]
            if bits == 0:
                continue
            for k in range(8):
                pixel = 8 * byte + k
                if pixel < len(count) and (bits >> k) & 1:
                    if count[pixel] == 0:
                        first[pixel] = tick
                    last[pixel] = tick
                    count[pixel] += 1


def calibrate(scene: Positional[Path], *, out: Path = Path("runs/calibration")) -> int:
    """Estimate gain and dark maps of a scene's cameras from its flat-field and dark recordings: OUT/CAM.npz and .png.

    Where the scene holds the true maps (truth/), the table says how far off the estimates are.

    Args:
        scene: Scene folder with calibration/flat and calibration/dark.
        out: Folder for the maps and their pictures.
    """
    from rich.console import Console
    from rich.table import Table

    opened = open_scene(scene)
    facts = opened.meta.get("calibration", {})
    if missing := {"flat_radiance", "flat_ticks", "dark_ticks"} - set(facts):
        lacks = f"calibration without {', '.join(sorted(missing))}"
        raise problem(scene / "scene.json", "facts of calibration recordings", lacks, "make a scene with recordings")
    table = Table(
        "camera", "spikes/tick, flat", "dark, median", "gain spread, %", "gain error, % RMS", "dark error, % RMS"
    )
    for camera in opened.cameras.values():
        flat, dark = (_recording(opened, camera, name, int(facts[f"{name}_ticks"])) for name in ("flat", "dark"))
        found = estimate(flat, dark, float(facts["flat_radiance"]))
        write_maps(out / f"{camera.id}.npz", {"gain": found.gain, "dark": found.dark})
        _draw(found, out / f"{camera.id}.png", camera.id)
        level, median = found.radiance_gain * float(facts["flat_radiance"]), float(np.median(found.dark))
        row = [camera.id, f"{level:.4f}", f"{median:.5f}", f"{100 * float(found.gain.std()):.2f}"]
        table.add_row(*row, *(f"{e:.3f}" if e is not None else "-" for e in truth_errors(opened, camera, found)))
    Console(width=120).print(table)
    print(f"maps and pictures: {out}")
    return 0


def truth_errors(scene: Scene, camera: Camera, found: Calibration) -> tuple[float | None, float | None]:
    """RMS error in percent of gain and dark map, each relative to the truth; None where the truth is not known."""
    path = f"truth/{camera.id}.npz"
    if path not in scene.manifest.files:
        return None, None
    with np.load(scene.manifest.path(path)) as truth:
        pairs = [(getattr(found, name), truth[name] if name in truth else None) for name in ("gain", "dark")]
    errors = [None if t is None else 100 * float(np.sqrt(np.mean((a / t - 1) ** 2))) for a, t in pairs]
    return errors[0], errors[1]


def _recording(scene: Scene, camera: Camera, name: str, n_ticks: int) -> SpikeStream:
    path = scene.manifest.path(f"calibration/{name}/{camera.id}.dat")
    bottom_up = bool(scene.meta["sensor"]["rows_bottom_up"])
    size = camera.width, camera.height
    return open_stream(path, *size, scene.rate_hz, rows_bottom_up=bottom_up, n_ticks=n_ticks)


def _draw(found: Calibration, path: Path, title: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for axes, image, name, limits in (
        (left, found.gain, "gain", (0.8, 1.2)),
        (right, 1000 * found.dark, "dark rate, spikes per 1000 ticks", (0, 20)),
    ):
        figure.colorbar(axes.imshow(image, vmin=limits[0], vmax=limits[1], cmap="viridis"), ax=axes)
        axes.set(title=f"{title}: {name}", xticks=[], yticks=[])
    with atomic_path(path) as part:
        figure.savefig(part, dpi=80)
