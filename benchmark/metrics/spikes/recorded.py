"""What a held-out camera says about a target: its response to light, and its spikes around the target's tick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.spikes.bad_pixels import from_recordings
from spike4dgs.benchmark.spikes.calibration import Recordings, estimate
from spike4dgs.benchmark.spikes.spans import Spans, is_recorded, spans_around
from spike4dgs.benchmark.spikes.stream import SpikeStream

Float64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

WINDOWS = (5, 20, 80)  # ticks of the counts: the shortest sees motion, the longest has the least noise of counting
SPAN_WINDOW = 20  # ticks that the judged intervals cover


@dataclass(frozen=True, eq=False)
class Response:
    """A camera's response to light, as its recordings of light and darkness tell.

    Attributes:
        white: [H, W], spikes per tick that a pixel adds under radiance 1.
        dark: [H, W], spikes per tick in the dark.
        unit: spikes per tick of white of the whole array, the unit of errors.
        good: [H, W], neither dead nor hot.
    """

    white: Float64
    dark: Float64
    unit: float
    good: Mask

    def rate(self, radiance: Float64) -> Float64:
        """Return the spikes per tick under radiance in [0, 1]: at most one a tick."""
        return np.minimum(self.white * radiance + self.dark, 1.0)


def response_of(recordings: Recordings | None, shape: tuple[int, int], radiance_gain: float) -> Response:
    """Return a camera's response; without recordings all pixels have the gain 1 and no dark rate, and none is bad."""
    if recordings is None:
        ones = np.ones(shape)
        return Response(radiance_gain * ones, 0 * ones, radiance_gain, np.ones(shape, np.bool_))
    found, bad = estimate(recordings), from_recordings(recordings.flat, recordings.dark)
    white, dark = radiance_gain * found.gain.astype(np.float64), found.dark.astype(np.float64)
    return Response(white, dark, radiance_gain, ~(bad.dead | bad.hot))


@dataclass(frozen=True, eq=False)
class Recorded:
    """Spikes around a tick: counts [H, W] of the WINDOWS that were recorded, and the spans around, if they were."""

    tick: int
    response: Response
    counts: Mapping[int, NDArray[np.uint16]]
    spans: Spans | None


def window_around(tick: int, length: int) -> tuple[int, int]:
    """Return the ticks [start, stop) around the beginning of a tick.

    >>> window_around(100, 20), window_around(100, 5)
    ((90, 110), (98, 103))
    """
    return tick - length // 2, tick - length // 2 + length


def record_around(stream: SpikeStream, tick: int, response: Response) -> Recorded:
    """Return what a stream holds around a tick; a window with a missing tick is left out."""
    windows = {length: window_around(tick, length) for length in WINDOWS}
    counts = {length: stream.counts(*ticks) for length, ticks in windows.items() if is_recorded(stream, *ticks)}
    around = window_around(tick, SPAN_WINDOW)
    return Recorded(tick, response, counts, spans_around(stream, *around) if is_recorded(stream, *around) else None)
