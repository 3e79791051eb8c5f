"""Facts about each camera for a report: rates, gaps, bad pixels and gains."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.bad_pixels import BadPixels, total_counts
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream


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
    seen = int(present(stream.gaps, stream.n_ticks).sum())
    rate = total_counts(stream) / max(seen, 1)
    low, high = np.percentile(rate, (1, 99))
    dead, hot, flickering = (int(mask.sum()) for mask in bad.kinds.values())
    mean = float(rate.mean())
    return CameraFacts(camera, stream.n_ticks - seen, mean, float(low), float(high), dead, hot, flickering, gain)
