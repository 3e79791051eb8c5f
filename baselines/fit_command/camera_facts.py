"""Facts about each camera for a report: rates, gaps, and bad pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.bad_pixels import from_recordings, total_counts
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream


@dataclass(frozen=True)
class CameraFacts:
    """Rates are spikes per tick over the ticks that the recording has; bad pixels are None where nothing tells."""

    camera: str
    missing: int  # ticks within gaps
    mean: float
    low: float  # 1st percentile of the pixels
    high: float  # 99th percentile
    dead: int | None
    hot: int | None


def camera_facts(scene: TrainingScene) -> list[CameraFacts]:
    """Return the facts about every training camera."""
    recordings = scene.recordings or (None,) * len(scene.cameras)
    return [
        _facts(camera.id, stream, found)
        for camera, stream, found in zip(scene.cameras, scene.streams, recordings, strict=True)
    ]


def _facts(camera: str, stream: SpikeStream, recordings: Recordings | None) -> CameraFacts:
    seen = int(present(stream.gaps, stream.n_ticks).sum())
    rate = total_counts(stream) / max(seen, 1)
    low, high = np.percentile(rate, (1, 99))
    dead = hot = None
    if recordings:
        bad = from_recordings(recordings.flat, recordings.dark)
        dead, hot = int(bad.dead.sum()), int(bad.hot.sum())
    return CameraFacts(camera, stream.n_ticks - seen, float(rate.mean()), float(low), float(high), dead, hot)
