"""What a report says of each camera: its rates, its gaps, and its bad pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.scene.calibration import Recordings, estimate
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream

DEAD_GAIN = 0.2  # of the mean sensitivity: a pixel below has no use; the spread of good ones is a few percent
HOT_DARK = 5.0  # median dark rates: a pixel above is hot; a log-normal spread reaches it once in 5,000 pixels
HOT_SPIKES = 5.0  # in the dark recording: fewer are chance
_LONGEST_COUNT = 65535  # ticks


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
    edges = [*range(0, stream.n_ticks, _LONGEST_COUNT), stream.n_ticks]
    counts = sum(stream.counts(a, b).astype(np.int64) for a, b in zip(edges, edges[1:], strict=False))
    seen = int(present(stream.gaps, stream.n_ticks).sum())
    rate = np.asarray(counts) / max(seen, 1)
    low, high = np.percentile(rate, (1, 99))
    bad = bad_pixels(recordings) if recordings else (None, None)
    return CameraFacts(camera, stream.n_ticks - seen, float(rate.mean()), float(low), float(high), *bad)


def bad_pixels(recordings: Recordings) -> tuple[int, int]:
    """Return how many pixels are dead and hot, by the recordings under uniform light and in the dark.

    Dead: less than `DEAD_GAIN` of the mean sensitivity. Hot: more than `HOT_DARK` times the median dark rate, and more
    than `HOT_SPIKES` spikes.
    """
    found = estimate(recordings)
    hot = (found.dark > HOT_DARK * np.median(found.dark)) & (found.dark * recordings.dark.n_ticks > HOT_SPIKES)
    return int((found.gain < DEAD_GAIN).sum()), int(hot.sum())
