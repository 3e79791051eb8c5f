"""Intervals: what a pixel gathered between two of its spikes, as a mean over a known span of time.

Between its spikes in ticks t_i and t_j a pixel gathers exactly j - i thresholds, whatever the light does in between.
So

    (j - i) / (t_j - t_i)    is the mean rate over    [t_i + 1/2, t_j + 1/2],

up to half a tick at either end: a standard error of sqrt(2 / 12) / (t_j - t_i) of itself, and shot noise. It is no
estimate of an instant: a fit compares it with its own mean over that span. The fit averages the noise of many short
spans; what it cannot undo is that a span hides detail. So spans are short. Of each pixel the spikes nearest to
tick - h and tick + h are taken, where h is one step below the window that `adaptive` finds, within limits: the sooner
light changes, the shorter its span.

A window that no change ends soon may still hide one of less than a spike: a faint texture that moves. So `adaptive`'s
rate over the whole window is taken only where light is constant for much longer than a span.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.bits import in_threads, kernel
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.spikes.times import spike_times
from spike4dgs.method.images.adaptive import AdaptiveSettings, gathered, half_windows, rates, shared_levels
from spike4dgs.method.images.base import ImageMaker


@dataclass(frozen=True)
class IntervalSettings(AdaptiveSettings):
    """The windows of `adaptive`, and the spans where light changes."""

    half: float = 6.0  # ticks on either side, at most: in twice that, what is fast moves about a pixel
    still: float = 80.0  # ticks on either side for which light must be constant to be taken as such

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.half >= self.shortest and self.still > 0):
            raise problem("intervals", "half not below shortest, still above 0", str(self), "correct the settings")


def half_spans(n_ticks: int, settings: IntervalSettings) -> Float32:
    """Return half the span in ticks of a pixel for each of `half_windows`; infinite where light is constant."""
    s, halves = settings, half_windows(n_ticks, settings)
    spans = (halves / s.growth).clip(s.shortest, s.half)
    # float32: 4.000000000000001 would tell apart two spikes that are equally near.
    return np.where((halves >= s.still) | (halves == halves[-1]), np.inf, spans).astype(np.float32)


def interval_image(
    stream: SpikeStream, tick: int, settings: IntervalSettings | None = None, light: Float64 | None = None
) -> Float32:
    """Return spikes per tick [H, W] float32, each the mean over its pixel's span around `tick`."""
    return intervals(stream, tick, settings, light)[0]


def intervals(
    stream: SpikeStream, tick: int, settings: IntervalSettings | None = None, light: Float64 | None = None
) -> tuple[Float32, Float32]:
    """Return spikes per tick [H, W] and the spans [2, H, W] that they are means over; see the module.

    `light` [n_ticks] is what `images.light.Light.gathered` has of it; None: it is steady.
    """
    s = settings or IntervalSettings()
    spikes, pixels = spike_times(stream), stream.height * stream.width
    levels = shared_levels(stream, tick, s, light)
    rate, halves = rates(stream, tick, s, levels, light), half_spans(stream.n_ticks, s)[levels]
    spans = np.empty((2, pixels), np.float32)
    spans[0], spans[1] = -s.half, s.half
    in_threads(_measure, pixels, spikes.ticks, spikes.starts, tick, halves, gathered(stream, light), rate, spans)
    image, ends = rate.reshape(stream.height, stream.width), spans.reshape(2, stream.height, stream.width)
    return (image[::-1], ends[:, ::-1]) if stream.rows_bottom_up else (image, ends)


@kernel
def _nearest(times: NDArray[np.int32], instant: float) -> int:
    """Return the index of the spike nearest to an instant; a spike of tick k is at k + 1/2."""
    after = int(np.searchsorted(times, instant - 0.5))
    if after == len(times) or (after > 0 and instant - 0.5 - times[after - 1] <= times[after] + 0.5 - instant):
        return after - 1
    return after


@kernel
def _measure(
    ticks: NDArray[np.int32],
    starts: NDArray[np.int64],
    tick: int,
    halves: Float32,
    light: NDArray[np.float64],
    rate: Float32,
    spans: Float32,
    start: int,
    stop: int,
) -> None:
    """Set rate and span of the pixels that change, from the spikes nearest to either end."""
    for p in range(start, stop):
        times = ticks[starts[p] : starts[p + 1]]
        if halves[p] == np.inf or len(times) < 2:
            continue
        i, j = _nearest(times, tick - halves[p]), _nearest(times, tick + halves[p])
        if i == j:  # one spike is nearest to both: the interval on the side where the tick lies
            i, j = (i - 1, j) if (times[i] >= tick and i > 0) or j + 1 == len(times) else (i, j + 1)
        rate[p] = np.float32((j - i) / (light[times[j]] - light[times[i]]))
        spans[0, p], spans[1, p] = times[i] + 0.5 - tick, times[j] + 0.5 - tick


INTERVALS = ImageMaker(
    name="intervals",
    definition="spikes / ticks from the spike nearest to tick - h to the one nearest to tick + h, with this span of "
    "time; h = adaptive's half window / growth, within [shortest, half]; as adaptive where its half window is at least "
    "`still` or the longest",
    source="this project",
    rate=interval_image,
    rate_over=intervals,
    knows_light=True,
    settings=IntervalSettings(),
    label="from the longest windows of constant light, and known spans where light changes",
)
