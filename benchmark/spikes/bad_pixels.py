"""Dead, hot and flickering pixels: from recordings of uniform light and of darkness, or from any stream by isolation.

A bright line is bright along itself, a hot pixel alone. Without recordings, a pixel is called bad where it differs from
all of its neighbours: bad pixels that touch each other, and hot ones in bright light, are then not found. A flickering
pixel's rate changes under steady light: its counts in windows of WINDOW_TICKS differ by more than the usual pixel's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float64, Mask
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.counted_recording import WINDOW_TICKS, Recording, total_counts
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.benchmark.spikes.stream import SpikeStream

FEWEST_SPIKES = 10  # fewer say nothing of a rate
HOT_SIGMA = 6.0  # robust standard deviations of its surroundings that a hot pixel is above its brightest neighbour,
HOT_SHARE = 0.5  # and share of that neighbour's rate: texture of one pixel seldom has more
FLICKER_FACTOR = 4.0  # times the usual deviation of counts that a flickering pixel has,
FLICKER_LEAST = 1.0  # and at least so many spikes: steady light's counts differ by one, which deviates by a half
_ROWS = 100  # compared with their surroundings at a time


@dataclass(frozen=True, eq=False)
class BadPixels:
    """Masks [H, W], and their source: `recordings` or `isolation`."""

    dead: Mask
    hot: Mask
    flickering: Mask
    source: str

    @property
    def kinds(self) -> dict[str, Mask]:
        """The masks by name."""
        return {"dead": self.dead, "hot": self.hot, "flickering": self.flickering}

    @property
    def all(self) -> Mask:
        """The pixels that are bad in any way."""
        return self.dead | self.hot | self.flickering


def find_bad(stream: SpikeStream, flat: Recording | None = None, dark: Recording | None = None) -> BadPixels:
    """Return the bad pixels of a camera: from its recordings, or without them by isolation in `stream`.

    The zeros within gaps count nowhere: they would hide a hot pixel as one that flickers.
    """
    if flat and dark:
        return from_recordings(flat, dark)
    held = present(set(stream.gaps) - set(stream.filled), stream.n_ticks)
    seen = max(int(held.sum()), 1)  # what was filled is among the counts
    return isolated(total_counts(stream) / seen, seen, deviation(stream, held))


def deviation(stream: Recording, held: Mask | None = None) -> Float64:
    """Return the standard deviation of each pixel's counts in windows of WINDOW_TICKS [H, W].

    What the whole chip does, as under a lamp that flickers, does not count, nor do windows with a tick that is not
    `held` [n_ticks]. Zero for fewer than two windows.
    """
    starts: Sequence[int] = range(0, stream.n_ticks - WINDOW_TICKS + 1, WINDOW_TICKS)
    if held is not None:
        starts = [start for start in starts if held[start : start + WINDOW_TICKS].all()]
    total = np.zeros((stream.height, stream.width))
    square = total.copy()
    for start in starts:
        counts = stream.counts(start, start + WINDOW_TICKS)
        own = counts - float(counts.mean())
        total += own
        square += own**2
    stream.release()
    n = max(len(starts), 1)
    return np.asarray(np.sqrt(np.maximum(square / n - (total / n) ** 2, 0)))


def flickering(stream: Recording) -> Mask:
    """Return the pixels [H, W] whose rate is not steady in a recording of steady light or of darkness."""
    found = deviation(stream)
    return found > max(FLICKER_FACTOR * float(np.median(found)), FLICKER_LEAST)


def from_recordings(flat: Recording, dark: Recording) -> BadPixels:
    """Return the pixels that never fire under uniform light, fire too often in the dark, or flicker in either.

    A pixel is dead only where a usual one has FEWEST_SPIKES spikes. A hot pixel's dark rate is at least
    `SENSOR.hot_factor` times the chip's median, in at least as many. Raises UserError where the recordings are of two
    sizes, or there is no light in the uniform one.
    """
    light, dark_spikes = total_counts(flat), total_counts(dark)
    if light.shape != dark_spikes.shape:
        found = f"{flat.width}x{flat.height} and {dark.width}x{dark.height}"
        raise problem("calibration", "two recordings of one size", found, "restore them")
    if (usual := float(np.median(light))) < 1:
        raise problem(flat.source, "a spike of a usual pixel", "none", "record uniform light for longer")
    hot = dark_spikes >= max(SENSOR.hot_factor * float(np.median(dark_spikes)), FEWEST_SPIKES)
    unsteady = flickering(flat) | flickering(dark)
    return BadPixels((light == 0) & (usual >= FEWEST_SPIKES), hot & ~unsteady, unsteady, "recordings")


def isolated(rate: Float64, n_ticks: int, deviation: Float64 | None = None) -> BadPixels:
    """Return the pixels of a mean rate [H, W], over `n_ticks`, that differ from all of their eight neighbours.

    A pixel is dead where it never fires although each neighbour fires at least FEWEST_SPIKES times. It is hot where it
    is above its brightest neighbour by HOT_SHARE of that one's rate and by HOT_SIGMA robust standard deviations of the
    24 pixels around it. It flickers where the same is true of the `deviation` of its counts [H, W], if that is given.
    """
    lowest, hot = _outstanding(rate, 1 / n_ticks)
    dead = (rate == 0) & (lowest * n_ticks >= FEWEST_SPIKES)
    unsteady = np.zeros_like(hot)
    if deviation is not None:
        unsteady = _outstanding(deviation, 1 / WINDOW_TICKS)[1] & (deviation > FLICKER_LEAST)
    return BadPixels(dead, hot & ~unsteady, unsteady, "isolation")


def _outstanding(image: Float64, least: float) -> tuple[Float64, Mask]:
    """Return the lowest neighbour of each pixel of an image [H, W], and which pixels are far above the highest.

    The deviation of a pixel's surroundings counts as at least `least`.
    """
    padded = np.pad(image, 2, mode="reflect")  # no pixel is its own neighbour
    lowest, above = np.zeros(image.shape), np.zeros(image.shape, np.bool_)
    for start in range(0, len(image), _ROWS):
        rows = slice(start, min(start + _ROWS, len(image)))
        lowest[rows], highest, spread = _surroundings(padded[rows.start : rows.stop + 4])
        excess = image[rows] - highest
        above[rows] = (excess > HOT_SHARE * highest) & (excess > HOT_SIGMA * np.maximum(spread, least))
    return lowest, above


def _surroundings(padded: Float64) -> tuple[Float64, Float64, Float64]:
    """Return the lowest and highest of 8 neighbours, and the robust standard deviation of 24, of all inner pixels."""
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).reshape(len(padded) - 4, -1, 25)
    around = np.delete(windows, 12, axis=-1)  # [H, W, 24], without the pixel itself
    touching = windows[..., [6, 7, 8, 11, 13, 16, 17, 18]]
    median = np.median(around, axis=-1, keepdims=True)
    spread = 1.4826 * np.median(np.abs(around - median), axis=-1)
    return touching.min(axis=-1), touching.max(axis=-1), spread
