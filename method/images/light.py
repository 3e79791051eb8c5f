"""Light that changes, as that of lamps on the mains or of a flash: its course, from the clip's still parts.

The radiance that a camera sees is R(x, t) f(t): what the scene shows, times the factor f of the light, with mean 1.
Blocks of pixels count spikes in short windows. Where nothing moves, a block's count over its mean is f, and noise. The
median over all blocks is a first f; the mean over the blocks that it explains best is the second. What moves is
explained by neither, as long as a quarter of the image is still.

A scene whose still blocks a constant explains as well has steady light, and is fitted as if this module were not there.

A lamp may light a part of the scene. Then still blocks follow the course with shares of their own: `local_light`.

This module does not: tell two lamps with courses of their own apart, see a flicker of less than 1 % RMS, one much
faster than its windows, or a lamp that lights less than three quarters of the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.scene.camera_state import Clock, local_window
from spike4dgs.benchmark.spikes.sensor_model import gathered
from spike4dgs.benchmark.spikes.stream import SpikeStream

_BLOCK = 16  # px
_WINDOW = 8  # ticks, 0.4 ms at 20 kHz: a sine of 100 Hz loses 0.3 % of its depth, one of 400 Hz 4 %
_LEAST_WINDOWS = 4
_NOISE = 1 / 6  # variance of a pixel's count under constant light: of rounding, whatever its phase
_STILL = 0.25  # of the brighter half of the blocks: as many are still, or nothing is known
_EXPLAINED = 0.5  # of a still block's variance, at most, is left where light changes
_STEADY = 2.0  # times the noise: a block that varies less shows steady light
_TOLD = 8.0  # times the noise, that the course would change a block: its own share is known to 5 %
_FOLLOWS = 0.1  # of a block's variance, at most, is left where it has a share of the course
_OTHER = 0.25  # that a block's share differs from the course's
_LOCAL = 0.05  # of the brighter blocks have another share: none has under one light, a third and more beside a lamp


@dataclass(frozen=True, eq=False)
class PixelLight:
    """The light of one camera's clip.

    gathered: up to the middle of each tick, in ticks of mean light [n_ticks].
    shares: of each pixel's light, in the stored order, that have this course [H * W]; the rest is steady. Images then
        show the light that there is. Empty: all light has it, and images show mean light.
    """

    gathered: Float64
    shares: Float32 = field(default_factory=lambda: np.empty(0, np.float32))

    def at(self, tick: int) -> Float32:
        """Return the factors of the pixels' light [H * W] at the start of a tick."""
        later = max(tick, 1)
        return 1 + self.shares * np.float32(self.gathered[later] - self.gathered[later - 1] - 1)


def steady(n_ticks: int) -> PixelLight:
    """Return light that does not change."""
    return PixelLight(np.arange(0.5, n_ticks))


@dataclass(frozen=True, eq=False)
class Light:
    """Factors of the light, with mean 1, over each tick of the array's clip [n_ticks].

    Where it is `local` it is that of a lamp, which is darkest at 0: each thing has a share of it, and a steady rest.
    """

    factors: Float64
    local: bool = False

    def gathered(self, clock: Clock, n_ticks: int) -> Float64:
        """Return the light gathered up to the middle of each tick of a camera's clip, in ticks of mean light [n_ticks].

        Under steady light tick k has k + 1/2. Beyond the array's clip light is the mean.
        """
        n, own = len(self.factors), np.arange(n_ticks) + 0.5
        at = np.array([clock.shared(tick) for tick in own])
        total = np.concatenate([[0.0], np.cumsum(self.factors)])
        inside = np.clip(at, 0, n)
        return np.asarray(np.interp(inside, np.arange(n + 1), total) + (at - inside) + clock.offset_ticks)


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
    factors = np.interp(np.arange(n_ticks) + 0.5, np.array(starts) + _WINDOW / 2, course)
    return Light(factors / factors.mean(), _differ(counts, mean, course - course.mean()))


def _differ(counts: Float64, mean: Float64, course: Float64) -> bool:
    """Return whether still blocks [B, n] of means [B, 1] have other shares of a course [n] around 0 than all of it."""
    noise, power = _NOISE * _BLOCK**2, np.square(course).mean()
    change = counts - mean
    slope = change @ course / (len(course) * power)
    variance = np.square(change).mean(axis=1)
    follow = variance - slope**2 * power <= np.maximum(_FOLLOWS * variance, _STEADY * noise)
    told = mean[:, 0] ** 2 * power > _TOLD * noise
    return bool(np.mean(follow & told & (np.abs(slope / mean[:, 0] - 1) > _OTHER)) > _LOCAL)


def _block_counts(stream: SpikeStream, clock: Clock, starts: Sequence[int]) -> Float64:
    """Return the spikes [blocks, windows] of a camera in windows of the array; incomplete blocks are left out.

    With dead ticks they are those that the pixels would have fired without.
    """
    rows, columns = stream.height // _BLOCK, stream.width // _BLOCK
    found = np.empty((rows * columns, len(starts)))
    for k, start in enumerate(starts):
        counts = stream.counts(*local_window(clock, start, start + _WINDOW, stream.n_ticks))
        whole = counts[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
        # The block's mean, as `gathered` is not linear: of single pixels it makes much more of 4 spikes than of 3.
        found[:, k] = gathered(whole.mean(axis=(1, 3)), stream.dead_ticks / _WINDOW).ravel() * _BLOCK**2
    stream.release()
    return found
