"""Scores of the image network on bursts that it was not trained on, beside `adaptive`'s."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.measure import mean
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.scene.training_bursts import BurstFile
from spike4dgs.method.image_network.network import ImageNetwork, rate_of
from spike4dgs.method.image_network.training.data import seen
from spike4dgs.method.image_network.training.sprites import with_sprites
from spike4dgs.method.matching.training.data import Recording, at_light

TICKS = 200  # of a clip
CONDITIONS = {
    "sensors known": at_light(1.0, ticks=TICKS),
    "sensors known, a quarter of the light": at_light(1 / 4, ticks=TICKS),
    "sensors known, a sixteenth": at_light(1 / 16, ticks=TICKS),
    "sensors unknown": at_light(1.0, known=False, ticks=TICKS),
}
_SPRITES, _INSTANTS = 2, (50, 100, 150)
_METRICS = ("psnr", "psnr_dynamic")


@dataclass(frozen=True)
class ImageScore:
    """Mean PSNR in dB of a condition, whole and where things move; None where nothing does."""

    condition: str
    adaptive: tuple[float | None, float | None]
    network: tuple[float | None, float | None]


def evaluate(network: ImageNetwork, files: Sequence[BurstFile]) -> list[ImageScore]:
    """Return the scores over one clip of each burst, with sprites before a view; the same files give the same."""
    return [_score(network, files, name, under) for name, under in CONDITIONS.items()]


def _score(network: ImageNetwork, files: Sequence[BurstFile], name: str, under: Recording) -> ImageScore:
    found: dict[str, list[tuple[float | None, ...]]] = {"adaptive": [], "network": []}
    device = next(network.parameters()).device
    for file, number in ((f, k) for f in files for k in range(len(f))):
        rng, burst = np.random.default_rng(number), file.read(number)
        images = burst.keys[len(burst.keys) // 2]
        view, *others = rng.permutation(len(images))[: 1 + _SPRITES].tolist()
        clip = with_sprites(images[view], [images[other] for other in others], TICKS, rng)
        sensor = (file.facts.radiance_gain, file.facts.photons_per_spike)
        batch = seen(clip, (burst.gain[view], burst.dark[view]), under, _INSTANTS, sensor, rng)
        with torch.inference_mode():
            roots = network(batch.channels.to(device), batch.spikes.to(device)).cpu()
        for k, unit in enumerate(batch.units):
            white = file.facts.radiance_gain * under.light
            truth, moving = rate_of(batch.truth[k], unit).numpy() / white, batch.moving[k].numpy()
            for maker, root in (("adaptive", batch.channels[k, 0]), ("network", roots[k])):
                pair = ImagePair(truth, rate_of(root, unit).numpy() / white, moving, f"{file.facts.id}, {number}")
                found[maker].append(tuple(METRICS[metric].measure(pair) for metric in _METRICS))
    return ImageScore(name, _mean(found["adaptive"]), _mean(found["network"]))


def _mean(values: Sequence[tuple[float | None, ...]]) -> tuple[float | None, float | None]:
    whole, moving = (mean([v for v in column if v is not None]) for column in zip(*values, strict=True))
    return whole, moving


def table(scores: Sequence[ImageScore]) -> str:
    """Return the scores as a table in Markdown."""
    heads = "| PSNR, dB (whole / moving) | adaptive | network |\n|---|---|---|\n"
    return heads + "".join(f"| {s.condition} | {_text(s.adaptive)} | {_text(s.network)} |\n" for s in scores)


def _text(values: tuple[float | None, float | None]) -> str:
    return " / ".join("-" if v is None else f"{v:.2f}" for v in values)
