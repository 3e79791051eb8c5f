"""Fixed-pattern maps of the simulated cameras: gain and dark rate of every pixel.

They follow calibrations of a real 250x400 spike camera: gain spread 5.8 % over the whole chip, most of it a smooth
shading; from pixel to pixel 3.2 % in a recording and 2.5 % in the calibrated map (robust, against the median of 5x5;
ours 2.8 %); dark rate log-normal around 0.0045 spikes per tick (1st to 99th percentile 0.0015 to 0.0128) with about one
hot pixel in a thousand, up to 50 times brighter. The real map's outliers along the edges of the chip are left out.
A camera keeps its maps: they depend on the seed, the camera and the resolution, not on the world.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spike4dgs.benchmark.files import atomic_path
from spike4dgs.generators.sensor.model import Float32

GAIN_SPREAD = 0.058  # standard deviation over the chip
GAIN_LOCAL_SPREAD = 0.0293  # of that, from pixel to pixel
DARK_MEDIAN = 0.0045  # spikes per tick
_DARK_LOG_SPREAD = 0.46
_HOT_SHARE = 9e-4
_HOT_FACTOR, _HOT_TAIL, _HOT_MOST = 5.0, 2.5, 50.0  # hot pixels: Pareto from 5 times the usual rate


def gain_map(height: int, width: int, seed: int, camera: str) -> Float32:
    """Relative sensitivity [H, W], mean 1: a smooth shading times independent pixels."""
    rng = _rng("gain", seed, camera)
    y, x = np.linspace(0, np.pi, height)[:, None], np.linspace(0, np.pi, width)[None]
    waves = [(i, j) for i in range(3) for j in range(3) if 0 < i + j <= 2]
    shading = np.zeros((height, width))
    for i, j in waves:
        shading += rng.normal() * np.cos(i * y) * np.cos(j * x)
    shading -= np.mean(shading)
    shading *= np.sqrt(GAIN_SPREAD**2 - GAIN_LOCAL_SPREAD**2) / max(np.std(shading), 1e-9)
    gain = np.exp(shading) * (1 + GAIN_LOCAL_SPREAD * np.clip(rng.normal(size=(height, width)), -6, 6))
    return np.asarray(gain / gain.mean(), dtype=np.float32)


def dark_map(height: int, width: int, seed: int, camera: str) -> Float32:
    """Dark rate [H, W] in spikes per tick."""
    rng = _rng("dark", seed, camera)
    dark = DARK_MEDIAN * np.exp(_DARK_LOG_SPREAD * rng.normal(size=(height, width)))
    hot = rng.random((height, width)) < _HOT_SHARE
    dark[hot] *= np.minimum(_HOT_FACTOR * (1 + rng.pareto(_HOT_TAIL, hot.sum())), _HOT_MOST)
    return np.asarray(dark, dtype=np.float32)


def write_maps(path: Path, maps: dict[str, Float32 | None]) -> None:
    """Write the maps that are on as `.npz` (equal maps give equal bytes); no file where none is."""
    if on := {name: m for name, m in maps.items() if m is not None}:
        with atomic_path(path) as part:
            np.savez(part, allow_pickle=False, **on)


def _rng(name: str, seed: int, camera: str) -> np.random.Generator:
    return np.random.default_rng([seed, *f"{camera} {name}".encode()])
