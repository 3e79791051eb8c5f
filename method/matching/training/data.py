"""Training samples of the matching network: views of a burst, as cameras of many kinds recorded them.

Beside views, brightness, mirror and direction of time (`method.msdi.training_data`) a sample draws its light, from all
to a sixteenth, its cameras' spread of sensitivity, dark rate and photons, whether these are known, and how long the
clip is: where nothing moves up to hundreds of ticks, else the 41 that a burst holds. The instant may be anywhere in the
clip: what lies before a gap, or after it, is not there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.scene.training_bursts import REACH, Burst, BurstFile
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.matching.config import MatcherTraining
from spike4dgs.method.matching.training.losses import Views
from spike4dgs.method.matching.window_inputs import window_inputs
from spike4dgs.method.msdi.training_data import Pixels, chosen, make_spikes, varied

RATE_HZ = 20_000.0
_DIMMEST_STOPS = 4.0  # halvings of the light: a sixteenth
_SPREAD = (0.5, 1.5)  # exponent of the sensitivity: half and three halves of its logarithm
_DARK_SD = 0.5  # of the logarithm of a factor of the dark rate
_PHOTONS = 2.0  # the largest factor; the smallest is its inverse
_SHORTEST = 2 * REACH - 1  # ticks
_EDGE = 10  # ticks at least on either side of the instant


@dataclass(frozen=True)
class Recording:
    """The conditions that a burst is recorded under."""

    light: float = 1.0  # factor of the radiance
    ticks: int = _SHORTEST
    instant: int = REACH - 1  # tick of the clip
    spread: float = 1.0  # exponent of the sensitivity
    dark: float = 1.0  # factor of the dark rate
    photons: float = 1.0  # factor of the photons of a spike
    known: bool = True  # the sensors are


class Conditions(Protocol):
    """What a training says of its recordings."""

    @property
    def longest(self) -> int:
        """Ticks of a clip at most."""

    @property
    def unknown_sensors(self) -> float:
        """Share of the recordings."""


def drawn(moves: bool, settings: Conditions, rng: np.random.Generator) -> Recording:
    """Return random conditions; where something moves the clip is as short as a burst."""
    ticks = _SHORTEST
    if not moves:
        ticks = int(np.exp(rng.uniform(np.log(_SHORTEST), np.log(settings.longest))))
    return Recording(
        light=float(2 ** -rng.uniform(0, _DIMMEST_STOPS)),
        ticks=ticks,
        instant=ticks // 2 if moves else int(rng.integers(_EDGE, ticks - _EDGE)),
        spread=float(rng.uniform(*_SPREAD)),
        dark=float(np.exp(_DARK_SD * rng.normal())),
        photons=float(_PHOTONS ** rng.uniform(-1, 1)),
        known=bool(rng.random() >= settings.unknown_sensors),
    )


def record(burst: Burst, gain: float, photons: float, under: Recording, rng: np.random.Generator) -> list[SpikeStream]:
    """Return the streams of a burst's views; `gain` is spikes per tick of white, `photons` those of a spike."""
    rates = burst.keys * np.float32(gain * under.light)
    sensitivity, dark = burst.gain**under.spread, burst.dark * under.dark
    pixels = Pixels(rates, np.asarray(sensitivity, np.float32), np.asarray(dark, np.float32), photons * under.photons)
    odd = under.ticks + 1 - under.ticks % 2
    spikes = make_spikes(pixels, odd, rng)[: under.ticks]  # [T, V, H, W]
    _, _, height, width = spikes.shape
    return [SpikeStream(pack(spikes[:, v]), width, height, RATE_HZ) for v in range(spikes.shape[1])]


def seen_by_network(burst: Burst, streams: Sequence[SpikeStream], under: Recording) -> Float32:
    """Return the network's inputs [V, 4, H, W] of a burst's streams."""
    found = []
    for v, stream in enumerate(streams):
        sensor = (burst.gain[v] ** under.spread, burst.dark[v] * under.dark) if under.known else None
        found.append(window_inputs(stream, under.instant, sensor))
    return np.stack(found)


@dataclass(frozen=True, eq=False)
class MatchBatch:
    """N views of several samples of one image size, and the ordered pairs of views of the same sample."""

    inputs: torch.Tensor  # [N, 4, H, W]
    views: Views
    pairs: torch.Tensor  # [P, 2]


def batch_of(bursts: Sequence[Burst], inputs: Sequence[NDArray[np.float32]]) -> MatchBatch:
    """Return bursts and their inputs as one batch."""
    truth = (np.concatenate([getattr(b, name) for b in bursts]) for name in ("depth", "K", "w2c"))
    depth, K, w2c = (torch.from_numpy(np.ascontiguousarray(x)).double() for x in truth)
    pairs, first = [], 0
    for burst in bursts:
        views = range(first, first + len(burst.K))
        pairs += [(a, b) for a in views for b in views if a < b]
        first += len(burst.K)
    return MatchBatch(torch.from_numpy(np.concatenate(inputs)), Views(depth, K, w2c), torch.tensor(pairs))


def draw(files: Sequence[BurstFile], settings: MatcherTraining, rng: np.random.Generator) -> MatchBatch:
    """Return random samples of files of one image size."""
    bursts, inputs = [], []
    for _ in range(settings.samples):
        file = files[int(rng.integers(len(files)))]
        burst = file.read(int(rng.integers(len(file))))
        views = rng.permutation(file.facts.views)[: settings.views]
        burst = varied(chosen(burst, views), rng)
        under = drawn(bool(burst.moving.any()), settings, rng)
        streams = record(burst, file.facts.radiance_gain, file.facts.photons_per_spike, under, rng)
        bursts.append(burst)
        inputs.append(seen_by_network(burst, streams, under))
    return batch_of(bursts, inputs)


def at_light(light: float, known: bool = True, ticks: int = _SHORTEST) -> Recording:
    """Return fixed conditions for scores, with the instant in the middle of the clip."""
    return replace(Recording(), light=light, known=known, ticks=ticks, instant=ticks // 2)
