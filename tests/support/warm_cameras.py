"""Cameras whose dark rates are others than in their recordings."""

import numpy as np

from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack

HEIGHT, WIDTH, N = 60, 90, 1500


def maps(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rates by light, gains and dark rates [H, W] of a scene with edges, fine texture and flat parts."""
    rng = np.random.default_rng(seed)
    light = 0.2 + 0.1 * np.sin(np.arange(WIDTH) / 9.0)[None] * np.ones((HEIGHT, 1))
    light[10:30, 20:50] = 0.4
    light[30:] += rng.uniform(-0.05, 0.05, (HEIGHT - 30, WIDTH))
    gain = 1 + 0.06 * rng.normal(size=light.shape)
    return light, gain / gain.mean(), rng.gamma(3.0, 0.005 / 3, light.shape)


def stream_of(rates: np.ndarray, n_ticks: int, seed: int) -> SpikeStream:
    """Return the spikes of constant rates [H, W] without noise."""
    charge = np.random.default_rng(seed).uniform(0, 1, rates.shape)
    ticks = charge + rates * np.arange(1, n_ticks + 1)[:, None, None]
    spikes = np.diff(np.floor(ticks), axis=0, prepend=0) > 0
    return SpikeStream(pack(spikes.astype(np.uint8)), WIDTH, HEIGHT, 20_000.0)


def warm_scene(scales: tuple[float, ...]) -> TrainingScene:
    """Return a scene of cameras whose dark rates are so many times those of their recordings."""
    streams, recordings = [], []
    for k, scale in enumerate(scales):
        light, gain, dark = maps(k)
        streams.append(stream_of(light * gain + scale * dark, N, k))
        flat, black = stream_of(0.42 * gain + dark, 500, 10 + k), stream_of(dark, 2000, 20 + k)
        recordings.append(Recordings(flat, black, 0.7))
    poses = (Camera(f"cam_{k:02d}", WIDTH, HEIGHT, 90, 90, 45, 30, np.eye(3), np.zeros(3)) for k in range(len(scales)))
    cameras = tuple(poses)
    return TrainingScene("s", "r", cameras, tuple(streams), 20_000.0, N, 0.6, recordings=tuple(recordings))
