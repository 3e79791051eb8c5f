"""TFP, texture from playback: the mean of the spikes in a window around the instant."""

from __future__ import annotations

import numpy as np
from spike4dgs.baselines.spike_to_image.images import Float32, ImageMaker
from spike4dgs.benchmark.spikes import SpikeStream

HALF_WINDOW = 20  # ticks on each side; the customary window of this camera is 41 ticks


def tfp_image(stream: SpikeStream, tick: int, half_window: int = HALF_WINDOW) -> Float32:
    """Spikes per tick [H, W] float32 over ticks [tick - half_window, tick + half_window), centred on the tick's start.

    At the clip's ends the window is what is left of it, and the mean divides by its true length.
    """
    start, stop = max(0, tick - half_window), min(stream.n_ticks, tick + half_window)
    return stream.counts(start, stop).astype(np.float32) / np.float32(stop - start)


TFP = ImageMaker(
    name="tfp",
    definition=f"mean of the spikes in [t - {HALF_WINDOW}, t + {HALF_WINDOW}) ticks",
    source="Zhu et al., ICME 2019",
    rate=tfp_image,
)
