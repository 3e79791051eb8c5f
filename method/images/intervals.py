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

Of a recording that lacks ticks, j - i may be in doubt: a span that holds D lost ticks in doubt for the pixel (see
`lost_spikes`) gathered anything from its k certain thresholds to k + D. Its rate is k / (T - D), what was recorded over
the time of the recording; the likeliest number errs less, but to the same side wherever light changes in the same way.
The span says what it may have gathered, and a fit's own model tells later how much it was (`training_views.instants`):
a spike is a tenth or more of a span, and a model that is halfway fitted is wrong by less.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64, Int64, UInt32, UInt64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.bits import in_threads, kernel
from spike4dgs.benchmark.spikes.lost_spikes import doubtful_between
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.spikes.trains import count_before, first_from, last_before, spike_trains
from spike4dgs.method.images.adaptive import AdaptiveSettings, half_windows, rates, shared_levels
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.images.light import PixelLight, steady


@dataclass(frozen=True)
class IntervalSettings(AdaptiveSettings):
    """The windows of `adaptive`, and the spans where light changes."""

    half: float = 6.0  # ticks on either side, at most: in twice that, what is fast moves about a pixel
    still: float = 80.0  # ticks on either side for which light must be constant to be taken as such

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.half >= self.shortest and self.still > 0):
            raise problem("intervals", "half not below shortest, still above 0", str(self), "correct the settings")

    def denser(self, pace: float) -> Self:
        """Return settings whose spans are so many times shorter, but never below the shortest."""
        return replace(self, half=max(self.shortest, self.half / pace))


def half_spans(n_ticks: int, settings: IntervalSettings) -> Float32:
    """Return half the span in ticks of a pixel for each of `half_windows`; infinite where light is constant."""
    s, halves = settings, half_windows(n_ticks, settings)
    spans = (halves / s.growth).clip(s.shortest, s.half)
    # float32: 4.000000000000001 would tell apart two spikes that are equally near.
    return np.where((halves >= s.still) | (halves == halves[-1]), np.inf, spans).astype(np.float32)


def interval_image(
    stream: SpikeStream, tick: int, settings: IntervalSettings | None = None, light: PixelLight | None = None
) -> Float32:
    """Return spikes per tick [H, W] float32, each the mean over its pixel's span around `tick`."""
    return intervals(stream, tick, settings, light)[0]


def intervals(
    stream: SpikeStream, tick: int, settings: IntervalSettings | None = None, light: PixelLight | None = None
) -> tuple[Float32, Float32, Float32 | None]:
    """Return spikes per tick [H, W], the spans [2, H, W] that they are means over, and their doubts; see the module.

    They are those of mean light; where `light` has shares, of the light that there is. None: light is steady. With
    shares a pixel whose window is long has the rate of `tick` itself, and an empty span. Doubts [3, H, W] are a span's
    spikes in doubt at most, the rate of one, and the rate without any; None where no tick is lost.
    """
    s = settings or IntervalSettings()
    trains, pixels, apart = spike_trains(stream), stream.height * stream.width, bool(light and len(light.shares))
    changing = light.gathered if light and not apart else steady(stream.n_ticks).gathered
    levels = shared_levels(stream, tick, s, light)
    rate, halves = rates(stream, tick, s, levels, light), half_spans(stream.n_ticks, s)[levels]
    spans = np.empty((2, pixels), np.float32)
    spans[0], spans[1] = (0, 0) if apart else (-s.half, s.half)
    doubts = np.zeros((3, pixels if stream.filled else 0), np.float32)
    in_threads(_measure, pixels, *trains.arrays, tick, halves, changing, rate, spans, doubts)
    image, ends, doubtful = (a.reshape(-1, stream.height, stream.width) for a in (rate, spans, doubts))
    if stream.rows_bottom_up:
        image, ends, doubtful = image[:, ::-1], ends[:, ::-1], doubtful[:, ::-1]
    return image[0], ends, doubtful if stream.filled else None


@kernel
def _nearest(words: UInt64, before: UInt32, pixel: int, total: int, instant: float, n_ticks: int) -> tuple[int, int]:
    """Return number and tick of the spike nearest to an instant, of `total`; a spike of tick k is at k + 1/2."""
    edge = min(max(int(np.ceil(instant - 0.5)), 0), n_ticks)
    after = count_before(words, before, pixel, edge)
    if after == total:
        return after - 1, last_before(words, pixel, edge)
    following = first_from(words, pixel, edge)
    if after > 0:
        earlier = last_before(words, pixel, edge)
        if instant - 0.5 - earlier <= following + 0.5 - instant:
            return after - 1, earlier
    return after, following


@kernel
def _measure(
    words: UInt64,
    before: UInt32,
    lost: Int64,
    doubt_words: UInt64,
    doubt_before: UInt32,
    tick: int,
    halves: Float32,
    light: Float64,
    rate: Float32,
    spans: Float32,
    doubts: Float32,
    start: int,
    stop: int,
) -> None:
    """Set rate, span and doubts of the pixels that change, from the spikes nearest to either end."""
    n = len(light)
    for p in range(start, stop):
        if halves[p] == np.inf:
            continue
        total = count_before(words, before, p, n)
        if total < 2:
            continue
        i, first = _nearest(words, before, p, total, tick - halves[p], n)
        j, last = _nearest(words, before, p, total, tick + halves[p], n)
        if i == j:  # one spike is nearest to both: the interval on the side where the tick lies
            if (first >= tick and i > 0) or j + 1 == total:
                i, first = i - 1, last_before(words, p, first)
            else:
                j, last = j + 1, first_from(words, p, last + 1)
        length, doubt = light[last] - light[first], 0
        if lost[last] > lost[first]:
            doubt, _ = doubtful_between(lost, doubt_words, doubt_before, p, first, last)
        if doubt > 0:
            doubts[0, p], doubts[1, p], doubts[2, p] = doubt, np.float32(1 / length), np.float32((j - i) / length)
            length *= 1 - doubt / (last - first)
        rate[p] = np.float32((j - i) / length)
        spans[0, p], spans[1, p] = first + 0.5 - tick, last + 0.5 - tick


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
