"""Fixed-pattern maps of the simulated cameras, gain and dark rate of every pixel, and their calibration recordings.

The gain is a smooth shading times independent pixels; the dark rate is log-normal with a few hot pixels. The constants
are those of `benchmark.spikes.sensor_model`. The outliers along the edges of the real camera's chip are not modelled.
A camera keeps its maps: they depend on the seed, the camera and the resolution, not on the world.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.benchmark.spikes.stream import SpikeWriter
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate


def gain_map(height: int, width: int, seed: int, camera: str) -> Float32:
    """Return the relative sensitivity [H, W], mean 1."""
    rng = _rng("gain", seed, camera)
    y, x = np.linspace(0, np.pi, height)[:, None], np.linspace(0, np.pi, width)[None]
    waves = [(i, j) for i in range(3) for j in range(3) if 0 < i + j <= 2]
    shading = np.zeros((height, width))
    for i, j in waves:
        shading += rng.normal() * np.cos(i * y) * np.cos(j * x)
    shading -= np.mean(shading)
    shading *= np.sqrt(SENSOR.gain_spread**2 - SENSOR.gain_local_spread**2) / max(np.std(shading), 1e-9)
    gain = np.exp(shading) * (1 + SENSOR.gain_local_spread * np.clip(rng.normal(size=(height, width)), -6, 6))
    return np.asarray(gain / gain.mean(), dtype=np.float32)


def dark_map(height: int, width: int, seed: int, camera: str) -> Float32:
    """Return the dark rate [H, W] in spikes per tick."""
    rng = _rng("dark", seed, camera)
    dark = SENSOR.dark_median * np.exp(SENSOR.dark_log_spread * rng.normal(size=(height, width)))
    hot = rng.random((height, width)) < SENSOR.hot_share
    dark[hot] *= np.minimum(SENSOR.hot_factor * (1 + rng.pareto(SENSOR.hot_tail, hot.sum())), SENSOR.hot_most)
    return np.asarray(dark, dtype=np.float32)


def write_maps(path: Path, maps: dict[str, Float32 | None]) -> None:
    """Write the maps that are on as `.npz` (equal maps give equal bytes), or no file if all are off."""
    if on := {name: m for name, m in maps.items() if m is not None}:
        with atomic_path(path) as part:
            np.savez(part, allow_pickle=False, **on)


def _rng(name: str, seed: int, camera: str) -> np.random.Generator:
    return np.random.default_rng([seed, *f"{camera} {name}".encode()])


FLAT_RADIANCE = 0.7  # at most
_FLAT_SPIKES = 0.84  # a tick, at most: from some 0.9 on many pixels fire in every tick, and hide their sensitivity
FLAT_TICKS = 500  # 25 ms
DARK_TICKS = 2000  # 100 ms: the darkest hundredth of the pixels fires every 670 ticks


def flat_radiance(radiance_gain: float) -> float:
    """Return the radiance of the uniform light of a recording: dimmer where a camera gets more than twice the light."""
    return min(FLAT_RADIANCE, _FLAT_SPIKES / radiance_gain)


def calibration_facts(radiance_gain: float) -> dict[str, Any]:
    """Return `calibration` of scene.json for the recordings of `write_calibration`, of sensors of this gain."""
    return {"flat_radiance": flat_radiance(radiance_gain), "flat_ticks": FLAT_TICKS, "dark_ticks": DARK_TICKS}


def noisy_sensor(camera: Camera, seed: int, noise_seed: Sequence[int]) -> Sensor:
    """Return a camera's sensor with all noise of the model: the maps of `seed`, and shot noise of `noise_seed`."""
    pixels = camera.height, camera.width, seed, camera.id
    photons = SENSOR.photons_per_spike
    return Sensor(gain=gain_map(*pixels), dark=dark_map(*pixels), photons=photons, noise_seed=tuple(noise_seed))


def noisy_facts() -> dict[str, Any]:
    """Return `sensor` of scene.json for `noisy_sensor`."""
    return {
        "model": SENSOR.name,
        "rows_bottom_up": True,
        "pixel_filter": "box",  # of the truth too
        "reset": SENSOR.reset,
        "most_spikes_per_tick": SENSOR.most_spikes_per_tick,
        "gain_map": True,
        "dark_map": True,
        "photons_per_spike": SENSOR.photons_per_spike,
    }


def write_calibration(folder: Path, camera: Camera, sensor: Sensor, entropy: Sequence[int]) -> None:
    """Record folder/flat/CAM.dat and folder/dark/CAM.dat with a simulated camera; `entropy`: of initial charges."""
    light = flat_radiance(sensor.radiance_gain)
    for name, radiance, n_ticks in (("flat", light, FLAT_TICKS), ("dark", 0.0, DARK_TICKS)):
        keys = [np.full((camera.height, camera.width), radiance, np.float32)] * 2
        charge = random_charge(camera.height, camera.width, [*entropy, *name.encode()])
        noise = (*sensor.noise_seed, *name.encode())
        same = replace(sensor, noise_seed=noise)
        with SpikeWriter(folder / name / f"{camera.id}.dat", camera.width, camera.height) as writer:
            for packed in simulate(keys, [0, n_ticks], n_ticks, same, charge):
                writer.write(packed)
