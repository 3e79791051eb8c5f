"""What the image network sees of a camera: `adaptive`'s windows with their error bars, spikes, and the sensor.

Windows tell what a pixel knows by itself, over as long as its light stays; spikes tell when it changed, and the
neighbours which of it is noise.

| channel | value |
|---|---|
| 0 to 3 | those of `method.matching.window_inputs`, without a largest value |
| 4, 5 | as 0, of the images `BESIDE` ticks before and after |
| 6, 7 | relative sensitivity less 1, and 1: both 0 where the sensor is unknown |

The spikes are those of `WINDOW` ticks around the instant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.adaptive import adaptive_image
from spike4dgs.method.images.base import window
from spike4dgs.method.matching.window_inputs import Maps, corrected_rates, rates_over_windows, roots_of

BESIDE = 12  # ticks
CHANNELS = 8


@dataclass(frozen=True, eq=False)
class ImageInputs:
    """What the network sees of one camera at one instant."""

    channels: Float32  # [CHANNELS, H, W]
    spikes: NDArray[np.uint8]  # [WINDOW, H, W] of 0 and 1
    unit: float  # spikes per tick, whose root is the unit of the channels' roots


def image_inputs(stream: SpikeStream, tick: int, sensor: Maps | None = None, of_pixels: bool = True) -> ImageInputs:
    """Return the inputs at the start of `tick`; `sensor` is relative sensitivity and dark rate, None if unknown.

    Where it is not known `of_pixels`, it corrects the images, but the network takes it as unknown. Beyond its ends the
    clip is mirrored.
    """
    windows = rates_over_windows(stream, tick, sensor)
    roots = windows.roots()
    last = stream.n_ticks - 1
    near = [adaptive_image(stream, min(max(tick + d, 0), last)) for d in (-BESIDE, BESIDE)]
    beside = [roots_of(corrected_rates(rates, sensor, stream.dead_ticks), windows.mean) for rates in near]
    known = np.zeros((2, stream.height, stream.width), np.float32)
    if sensor and of_pixels:
        known[0], known[1] = sensor[0] - 1, 1
    channels = [roots[0], windows.log_length, roots[1], roots[2], *beside, *known]
    return ImageInputs(np.stack(channels).astype(np.float32), window(stream, tick), windows.mean)
