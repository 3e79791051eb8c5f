"""Training samples of the image network: crops of rendered views, with sprites before them, as many cameras see them.

Every use draws anew: what moves and how (`sprites`), the light, the sensor, whether it is known, the length of the
clip, and instants anywhere in it. A known sensor is known as well as `calibration.estimate` finds it by intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.scene.training_bursts import Burst, BurstFile
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.image_network.config import ImageTraining
from spike4dgs.method.image_network.inputs import image_inputs
from spike4dgs.method.image_network.training.sprites import Clip, still, with_sprites
from spike4dgs.method.matching.training.data import RATE_HZ, Recording, drawn
from spike4dgs.method.msdi.training_data import Pixels, fire

# Of a sensor's maps: relative sd, and in spikes per tick. Measured on two scenes of the track `ideal` (car, motor).
_GAIN_ERROR, _DARK_ERROR = 9e-4, 8e-6
_BRIGHTER = 1.4  # at most; the least is its inverse


@dataclass(frozen=True, eq=False)
class ImageBatch:
    """N images: what the network sees, and what is true, both in roots of the unit, less 1."""

    channels: Tensor  # [N, CHANNELS, H, W]
    spikes: Tensor  # [N, WINDOW, H, W] uint8
    truth: Tensor  # [N, H, W]
    moving: Tensor  # [N, H, W] bool
    units: tuple[float, ...]  # spikes per tick


def draw(files: Sequence[BurstFile], settings: ImageTraining, rng: np.random.Generator) -> ImageBatch:
    """Return random samples of files whose crops have one size."""
    parts: list[ImageBatch] = []
    for _ in range(settings.bursts):
        file = files[int(rng.integers(len(files)))]
        burst = file.read(int(rng.integers(len(file))))
        for v in rng.permutation(len(burst.K))[: settings.views]:
            parts.append(_sample(burst, file, int(v), settings, rng))
    return joined(parts)


def crop_size(size: tuple[int, int], settings: ImageTraining) -> tuple[int, int]:
    """Return the size (h, w) of the parts that are taken of images of a size (H, W)."""
    height, width = settings.crop
    return min(size[0], height), min(size[1], width)


def joined(parts: Sequence[ImageBatch]) -> ImageBatch:
    """Return the parts as one."""
    return ImageBatch(
        channels=torch.cat([part.channels for part in parts]),
        spikes=torch.cat([part.spikes for part in parts]),
        truth=torch.cat([part.truth for part in parts]),
        moving=torch.cat([part.moving for part in parts]),
        units=tuple(unit for part in parts for unit in part.units),
    )


def _sample(burst: Burst, file: BurstFile, view: int, settings: ImageTraining, rng: np.random.Generator) -> ImageBatch:
    images = burst.keys[len(burst.keys) // 2]
    facts = file.facts
    size = crop_size((facts.height, facts.width), settings)
    under = drawn(False, settings, rng)
    if rng.random() < settings.well_lit:
        under = replace(under, light=float(rng.uniform(0.5, 1)))
    image = _part(images[view], size, rng) * np.float32(_BRIGHTER ** rng.uniform(-1, 1))
    count = int(rng.integers(1, 4)) if rng.random() < settings.moving else 0
    others = [images[int(rng.integers(len(images)))] for _ in range(count)]
    clip = with_sprites(image, others, under.ticks, rng) if count else still(image, under.ticks)
    gain, dark = (_part(maps[view], size, rng) for maps in (burst.gain, burst.dark))
    instants = rng.integers(0, under.ticks, settings.instants).tolist()
    return seen(clip, (gain, dark), under, instants, (facts.radiance_gain, facts.photons_per_spike), rng)


def seen(
    clip: Clip,
    maps: tuple[Float32, Float32],
    under: Recording,
    instants: Sequence[int],
    sensor: tuple[float, float],
    rng: np.random.Generator,
) -> ImageBatch:
    """Return what is seen of a clip at some instants.

    `maps` are relative sensitivity and dark rate [H, W], `sensor` spikes per tick of white and photons of a spike.
    """
    radiance_gain, photons = sensor
    factor = np.float32(radiance_gain * under.light)
    gain, dark = np.asarray(maps[0] ** under.spread, np.float32), np.asarray(maps[1] * under.dark, np.float32)
    pixels = Pixels(clip.keys * factor, gain, dark, photons * under.photons, clip.spacing)
    spikes = fire(pixels, under.ticks, rng.random(gain.shape, np.float32), rng)
    height, width = gain.shape
    stream = SpikeStream(pack(spikes), width, height, RATE_HZ)
    known = None
    if under.known:
        known = (
            np.asarray(gain * (1 + _GAIN_ERROR * rng.standard_normal(gain.shape)), np.float32),
            np.asarray(dark + _DARK_ERROR * rng.standard_normal(gain.shape), np.float32),
        )
    found = [image_inputs(stream, tick, known) for tick in instants]
    truth = [clip.at(tick) for tick in instants]
    roots = [
        np.sqrt(np.clip(t * factor, 0, 1) / np.float32(f.unit)) - 1 for (t, _), f in zip(truth, found, strict=True)
    ]
    return ImageBatch(
        torch.from_numpy(np.stack([f.channels for f in found])),
        torch.from_numpy(np.stack([f.spikes for f in found])),
        torch.from_numpy(np.stack(roots).astype(np.float32)),
        torch.from_numpy(np.stack([moving for _, moving in truth])),
        tuple(f.unit for f in found),
    )


def _part(image: Float32, size: Sequence[int], rng: np.random.Generator) -> Float32:
    """Return a random part, at random upside down and mirrored."""
    first = [int(rng.integers(0, side - own + 1)) for side, own in zip(image.shape, size, strict=True)]
    part = image[first[0] : first[0] + size[0], first[1] : first[1] + size[1]]
    flips = rng.choice([-1, 1], 2)
    return np.ascontiguousarray(part[:: flips[0], :: flips[1]])
