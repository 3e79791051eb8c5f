"""Light that changes for the whole scene, as that of lamps on the mains: its course, from the clip's still parts.

The radiance that a camera sees is R(x, t) f(t): what the scene shows, times the factor f of the light, with mean 1.
Blocks of pixels count spikes in short windows. Where nothing moves, a block's count over its mean is f, and noise. The
median over all blocks is a first f; the mean over the blocks that it explains best is the second. What moves is
explained by neither, as long as a quarter of the image is still.

A scene whose still blocks a constant explains as well has steady light, and is fitted as if this module were not there.

This module does not: tell lamps apart, see a flicker of less than 1 % RMS or one much faster than its windows.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.scene.camera_state import Clock, local_window
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.sensor_model import gathered
from spike4dgs.benchmark.spikes.stream import SpikeStream

_BLOCK = 16  # px
_WINDOW = 8  # ticks, 0.4 ms at 20 kHz: a sine of 100 Hz loses 0.3 % of its depth, one of 400 Hz 4 %
_LEAST_WINDOWS = 4
_NOISE = 1 / 6  # variance of a pixel's count under constant light: of rounding, whatever its phase
_STILL = 0.25  # of the brighter half of the blocks: as many are still, or nothing is known
_EXPLAINED = 0.5  # of a still block's variance, at most, is left where light changes
_STEADY = 2.0  # times the noise: a block that varies less shows steady light


@dataclass(frozen=True, eq=False)
class Light:
    """Factors of the light, with mean 1, over each tick of the array's clip [n_ticks]."""

    factors: Float64

    def gathered(self, clock: Clock, n_ticks: int) -> Float64:
        """Return the light gathered up to the middle of each tick of a camera's clip, in ticks of mean light [n_ticks].

        Under steady light tick k has k + 1/2. Beyond the array's clip light is the mean.
        """
        n, own = len(self.factors), np.arange(n_ticks) + 0.5
        at = np.array([clock.shared(tick) for tick in own])
        total = np.concatenate([[0.0], np.cumsum(self.factors)])
        inside = np.clip(at, 0, n)
        return np.asarray(np.interp(inside, np.arange(n + 1), total) + (at - inside) + clock.offset_ticks)


def light_of(scene: TrainingScene) -> Light | None:
    """Return what changes in the light of a scene, and say so on stderr; None: it is steady."""
    light = estimate_light(scene.streams, [scene.state(camera.id).clock for camera in scene.cameras])
    if light:
        spread = 100 * float(np.std(light.factors))
        print(f"the light changes by {spread:.1f} % RMS: fitted in its mean", file=sys.stderr)
    return light


def estimate_light(streams: Sequence[SpikeStream], clocks: Sequence[Clock]) -> Light | None:
    """Return the light of a clip from its streams, each with its camera's clock; None: it is steady."""
    n_ticks = min(stream.n_ticks for stream in streams)
    starts = range(0, n_ticks - _WINDOW + 1, _WINDOW)
    if len(starts) < _LEAST_WINDOWS:
        return None
    counts = np.concatenate([_block_counts(s, c, starts) for s, c in zip(streams, clocks, strict=True)])
    counts = counts[counts.sum(axis=1) > 0]
    if not len(counts):
        return None
    mean = counts.mean(axis=1)
    bright = mean >= np.median(mean)  # dark blocks show noise
    counts, mean = counts[bright], mean[bright, None]
    changes = np.square(counts - mean).mean(axis=1)
    course = np.median(counts / mean, axis=0)
    rest = np.square(counts - mean * course).mean(axis=1) / np.maximum(changes, 1e-9)
    still = rest <= np.quantile(rest, _STILL)
    if np.quantile(changes, _STILL) < _STEADY * _NOISE * _BLOCK**2 or rest[still].max() > _EXPLAINED:
        return None
    course = (counts[still] * mean[still]).sum(axis=0) / np.square(mean[still]).sum()
    ticks = np.arange(n_ticks) + 0.5
    factors = np.interp(ticks, np.array(starts) + _WINDOW / 2, course)
    return Light(factors / factors.mean())


def _block_counts(stream: SpikeStream, clock: Clock, starts: Sequence[int]) -> Float64:
    """Return the spikes [blocks, windows] of a camera in windows of the array; incomplete blocks are left out."""
    rows, columns = stream.height // _BLOCK, stream.width // _BLOCK
    found = np.empty((rows * columns, len(starts)))
    for k, start in enumerate(starts):
        counts = stream.counts(*local_window(clock, start, start + _WINDOW, stream.n_ticks))
        whole = gathered(counts[: rows * _BLOCK, : columns * _BLOCK].astype(np.float64), stream.dead_ticks / _WINDOW)
        found[:, k] = whole.reshape(rows, _BLOCK, columns, _BLOCK).sum(axis=(1, 3)).ravel()
    stream.release()
    return found
