"""What the matching network sees of a camera: `adaptive`'s image, its error bars, and a shorter and a longer window.

Long windows serve low light, and where things move `adaptive` shortens them by itself. The network adds to the
estimate that is already there, and knows how far to trust it.

| channel | value |
|---|---|
| 0 | root of the rate over `adaptive`'s window, in means of the image, less 1 |
| 1 | log2 of that window's ticks, over 8: a rate lies within one over so many ticks of the spikes' |
| 2 | as 0, over the shortest window |
| 3 | as 0, over the whole stream |

The root makes shot noise alike in the dark and in the light; the mean takes out light and exposure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.spikes.sensor_model import fired, gathered
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.adaptive import AdaptiveSettings, half_windows, rates, shared_levels

CHANNELS = 4
_MOST = 4.0  # of a root, in roots of the mean: a hot pixel must not outshine everything
_PART = 65535  # ticks counted at once
_LEAST = 1e-4  # spikes per tick: the mean of an image that is dark throughout

Maps = tuple[Float32, Float32]  # relative sensitivity and dark rate [H, W]


def window_inputs(stream: SpikeStream, tick: int, sensor: Maps | None = None) -> Float32:
    """Return the channels [4, H, W] at the start of `tick`; `sensor` None where it is unknown.

    A pixel without sensitivity has rate 0.
    """
    windows = rates_over_windows(stream, tick, sensor)
    roots = np.minimum(windows.roots(), _MOST - 1)
    return np.stack([roots[0], windows.log_length, roots[1], roots[2]]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Windows:
    """What a pixel's own spikes say at a tick, corrected for the sensor where that is known."""

    rates: Float32  # [3, H, W] spikes per tick over adaptive's window, the shortest, and the whole stream
    log_length: Float32  # [H, W] log2 of the ticks of adaptive's, over 8
    mean: float  # spikes per tick of the image over the whole stream

    def roots(self) -> Float32:
        """Return roots of the rates in roots of the mean, less 1."""
        return roots_of(self.rates, self.mean)


def rates_over_windows(stream: SpikeStream, tick: int, sensor: Maps | None = None) -> Windows:
    """Return rates over three windows at the start of `tick`."""
    settings = AdaptiveSettings()
    levels = shared_levels(stream, tick, settings)
    found = [rates(stream, tick, settings, which) for which in (levels, np.zeros_like(levels))]
    ticks = np.minimum(2 * half_windows(stream.n_ticks, settings)[levels], stream.n_ticks)
    adaptive, short, length = (_upright(stream, image) for image in (*found, ticks.astype(np.float32)))
    # Not `total_counts`: it gives back the stream's pages, which the next instant reads again.
    parts = [stream.counts(a, min(a + _PART, stream.n_ticks)) for a in range(0, stream.n_ticks, _PART)]
    whole = np.sum(parts, axis=0, dtype=np.int64).astype(np.float32) / stream.n_ticks
    images = corrected_rates(np.stack([adaptive, short, whole]), sensor, stream.dead_ticks)
    return Windows(images, np.asarray(np.log2(length) / 8, np.float32), max(float(images[2].mean()), _LEAST))


def corrected_rates(images: Float32, sensor: Maps | None, dead_ticks: float) -> Float32:
    """Return the rates [..., H, W] of an ideal sensor with the same dead ticks, not negative.

    The maps of the sensor are of the charge, which is in proportion to light.
    """
    if not sensor:
        return np.maximum(images, 0)
    gain, dark = sensor
    charge = (gathered(images, dead_ticks) - dark) * np.where(gain > 0, 1 / np.where(gain > 0, gain, 1), 0)
    rates: Float32 = fired(np.maximum(charge, 0), dead_ticks)
    return rates


def roots_of(rates: Float32, mean: float) -> Float32:
    """Return roots of rates in roots of `mean`, less 1."""
    return np.asarray(np.sqrt(rates / mean) - 1, np.float32)


def light_of(roots: Float32) -> Float32:
    """Return the light in means of the image from channel 0, 2 or 3."""
    return np.asarray((roots + 1) ** 2, np.float32)


def _upright(stream: SpikeStream, image: Float32) -> Float32:
    image = image.reshape(stream.height, stream.width)
    return image[::-1] if stream.rows_bottom_up else image
