"""TFP, texture from playback: the mean of the spikes in a window around the instant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.settings import Settings


@dataclass(frozen=True)
class TfpSettings(Settings):
    """TFP's window."""

    half_window: int = 20  # ticks on each side; 41 ticks in all are customary for this camera


HALF_WINDOW = TfpSettings.half_window


def tfp_image(stream: SpikeStream, tick: int, half_window: int = HALF_WINDOW) -> Float32:
    """Return spikes per tick [H, W] float32 over ticks [tick - half_window, tick + half_window).

    The window is centred on the tick's start. At the clip's ends it is cut, and the mean divides by its true length.
    Raises UserError for a half window outside 1 ... 32767.
    """
    if not 1 <= half_window <= 32767:
        raise problem("half_window", "1 to 32767 ticks", str(half_window), "choose a window in this range")
    start, stop = max(0, tick - half_window), min(stream.n_ticks, tick + half_window)
    return stream.counts(start, stop).astype(np.float32) * (np.float32(1) / np.float32(stop - start))


TFP = ImageMaker(
    name="tfp",
    definition="mean of the spikes in ticks [t - half_window, t + half_window)",
    source="Zhu, Dong, Huang, Tian: A retina-inspired sampling method for visual texture reconstruction, ICME 2019",
    rate=lambda stream, tick, settings: tfp_image(stream, tick, settings.half_window),
    settings=TfpSettings(),
    label="from spike counts",
)
