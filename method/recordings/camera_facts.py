"""Facts about each camera of a recording: rates, gaps, bad pixels, and relative gains.

Relative gains of the cameras of an array: from uniform light, or from points that several of them see.

A point looks about as bright from all cameras of a small array. The ratio of what two cameras show of it is then that
of their gains, but for noise, fixed patterns and gloss; medians over thousands of points leave little of these.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.bad_pixels import BadPixels
from spike4dgs.benchmark.spikes.counted_recording import mean_rate
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.starts.clip import SpikeClip
from spike4dgs.method.starts.rig import PointSettings, look_up, matched

LEAST_RADIANCE = 0.02  # of a point, white is 1: a few spikes say little of a ratio
OWN_ERROR = 0.01  # of an estimate between views, by fixed patterns and gloss: measured on an emulated array
FEWEST_POINTS = 200  # that a camera shares with others
_ROUNDS = 10  # of medians over cameras and over points, in turn; three are enough


def from_recordings(scene: TrainingScene) -> Float64 | None:
    """Return the gains [C], mean 1, from the recordings of uniform light; None where there are none."""
    if scene.calibrations is None:
        return None
    gains = np.array([c.radiance_gain for c in scene.calibrations], np.float64)
    return gains / gains.mean()


def between_views(scene: TrainingScene) -> Float64 | None:
    """Return the gains [C], mean 1, from what the cameras show of the same points; None where they share too few."""
    settings = PointSettings()
    cloud, means = matched(scene, settings, SpikeClip(scene, settings.window_ticks, flat_field=False))
    smooth = [cv2.blur(image, (3, 3)) for image in means]  # a pose that is off by a pixel matters less
    seen = np.stack([look_up(c, m, cloud.points) for c, m in zip(scene.cameras, smooth, strict=True)])
    bright = np.nanmin(np.where(np.isfinite(seen), seen, np.inf), axis=0) > LEAST_RADIANCE
    logs = np.log(seen[:, bright & (np.isfinite(seen).sum(axis=0) >= 2)])
    if not logs.size or np.isfinite(logs).sum(axis=1).min() < FEWEST_POINTS:
        return None
    gains = np.exp(log_gains(logs))
    return shrunk(gains / gains.mean())


def shrunk(gains: Float64) -> Float64:
    """Return gains of mean 1 nearer to 1, by the share of their variance that OWN_ERROR explains."""
    variance = max(float(gains.var()), OWN_ERROR**2)
    return np.asarray(1 + (gains - 1) * (1 - OWN_ERROR**2 / variance))


def log_gains(logs: Float64) -> Float64:
    """Return g [C] of logs [C, N] = g[c] + value[n] + outliers, by medians; NaN where a camera does not see a point."""
    found = np.zeros(len(logs))
    for _ in range(_ROUNDS):
        values = np.nanmedian(logs - found[:, None], axis=0)
        found = np.nanmedian(logs - values, axis=1)
        found -= found.mean()
    return found


@dataclass(frozen=True)
class CameraFacts:
    """Rates are spikes per tick over the ticks that the recording has."""

    camera: str
    missing: int  # ticks within gaps
    mean: float
    low: float  # 1st percentile of the pixels
    high: float  # 99th percentile
    dead: int
    hot: int
    flickering: int
    gain: float  # beside the array's


def camera_facts(
    scene: TrainingScene, recorded: Mapping[str, SpikeStream], bad: Mapping[str, BadPixels]
) -> tuple[CameraFacts, ...]:
    """Return the facts about every camera of a scene. `recorded` are the streams before any repair."""
    return tuple(_facts(c.id, recorded[c.id], bad[c.id], scene.state(c.id).gain) for c in scene.cameras)


def _facts(camera: str, stream: SpikeStream, bad: BadPixels, gain: float) -> CameraFacts:
    lost, rate = int((~present(stream.gaps, stream.n_ticks)).sum()), mean_rate(stream)
    low, high = np.percentile(rate, (1, 99))
    dead, hot, flickering = (int(mask.sum()) for mask in bad.kinds.values())
    mean = float(rate.mean())
    return CameraFacts(camera, lost, mean, float(low), float(high), dead, hot, flickering, gain)
