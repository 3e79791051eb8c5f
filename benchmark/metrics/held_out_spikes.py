"""What a held-out camera's own spikes say about a prediction.

The law of recorded intervals: how probable is it that a pixel took so many ticks for so many spikes?

A pixel under steady light takes 1 / rate ticks for a spike, and a spike is read out in the tick in which it falls. The
n intervals after a spike therefore last m ticks with the probability tri(m - n / rate), where tri(x) = max(0, 1 - |x|):
one of two neighbouring numbers. Shot noise makes the charge of n spikes vary by sqrt(n / photons).

That law alone is too sharp to judge a model: in the dark an interval of 100 ticks tells the rate to a thousandth, and
the score would be that of the darkest pixels. A render is not asked to be better than a tolerance: its rate is taken to
be known with this standard deviation, and the law is averaged over it. tri is only two ticks wide, so m - n / rate is
linear in the rate where it counts, at the recorded rate n / m (to one part in m; spans are 20 ticks and longer):

    P(m | n, rate) = E tri(d + s Z),   d = (rate m / n - 1) m,   s^2 = (tolerance m^2 / n)^2 + (m / n)^2 n / photons

with a standard normal Z. E max(0, x + s Z) = s H(x / s), H(u) = u Phi(u) + phi(u), gives it in closed form.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64, Mask
from spike4dgs.benchmark.scene.calibration import Recordings, estimate
from spike4dgs.benchmark.spikes.bad_pixels import from_recordings
from spike4dgs.benchmark.spikes.sensor_model import SENSOR, fired
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.spikes.times import Spans, is_recorded, spans_around


def log_probability(intervals: Float64, ticks: Float64, rate: Float64, tolerance: float, photons: float) -> Float64:
    """Return log P(ticks | intervals, rate), elementwise: `rate` and `tolerance` in spikes per tick."""
    spread = np.sqrt((tolerance * ticks**2 / intervals) ** 2 + ticks**2 / (intervals * photons))
    return _log_mean_triangle((rate * ticks / intervals - 1) * ticks, spread)


_WIDE = 1e4  # a spread beside which the triangle is a point: of the second difference below nothing would be left


def _log_mean_triangle(d: Float64, s: Float64) -> Float64:
    """Return log E tri(d + s Z). All three terms are taken on the side where they are small: nothing cancels there.

    They differ by parts of 1 / s^2. Where that is no more, the triangle has the area 1 at one place.
    """
    wide = s > _WIDE
    near, side = np.where(wide, 1.0, s), np.where(wide, 0.0, -np.abs(d))
    a, b, c = (_log_h((side + x) / near) for x in (1, 0, -1))
    exact = np.log(near) + a + np.log1p(np.exp(c - a) - 2 * np.exp(b - a))
    return np.asarray(np.where(wide, -((d / s) ** 2) / 2 - np.log(s) - np.log(2 * np.pi) / 2, exact))


def _log_h(u: Float64) -> Float64:
    """Return log(u Phi(u) + phi(u)) for any u: with Mills' ratio where u is negative."""
    from scipy.special import erfcx, ndtr  # only where spikes are scored

    below = np.minimum(u, 0)
    mills = np.sqrt(np.pi / 2) * erfcx(-below / np.sqrt(2))
    density = -(u**2) / 2 - np.log(2 * np.pi) / 2
    above = np.maximum(u, 0)
    positive = above * ndtr(above) + np.exp(-(above**2) / 2) / np.sqrt(2 * np.pi)
    return np.asarray(np.where(u < 0, density + np.log1p(below * mills), np.log(positive)))


def time_mean(
    ticks: Sequence[int], images: Sequence[Float64], start: float | Float64, stop: float | Float64
) -> Float64:
    """Return the mean [H, W] of images at ascending ticks over the time from `start` to `stop`, in ticks.

    `start` and `stop` are numbers, or one for each pixel [H, W]. An image belongs to the instant at which its tick
    begins.

    >>> time_mean([0, 10], [np.zeros((1, 1)), np.ones((1, 1))], 5.0, 15.0)
    array([[0.875]])
    """
    mean = images[0].copy()
    for (a, before), (b, image) in zip(
        zip(ticks[:-1], images[:-1], strict=True), zip(ticks[1:], images[1:], strict=True), strict=True
    ):
        share = (_ramp_area(stop, a, b) - _ramp_area(start, a, b)) / (np.asarray(stop) - start)
        if np.any(share):
            mean += share * (image - before)
    return mean


def _ramp_area(x: float | Float64, a: int, b: int) -> Float64:
    """Return the area up to x under a function that is 0 before a, rises to 1 at b, and stays there."""
    risen = np.clip(np.asarray(x, np.float64) - a, 0, b - a)
    return np.asarray(risen**2 / (2 * (b - a)) + np.maximum(np.asarray(x, np.float64) - b, 0))


WINDOWS = (5, 20, 80)  # ticks of the counts: the shortest sees motion, the longest has the least noise of counting
SPAN_WINDOW = 20  # ticks that the judged intervals cover


@dataclass(frozen=True, eq=False)
class Response:
    """A camera's response to light, as its recordings of light and darkness tell."""

    white: Float64  # [H, W] charge per tick that a pixel adds under radiance 1, in spikes
    dark: Float64  # [H, W] charge per tick in the dark
    unit: float  # spikes per tick of white of the whole array, the unit of errors
    good: Mask  # [H, W] neither dead, nor hot, nor flickering
    dead_ticks: float = 0.0  # after a spike, in which a pixel gathers nothing

    def rate(self, radiance: Float64) -> Float64:
        """Return the spikes per tick under radiance in [0, 1]: at most one a tick."""
        return np.asarray(np.minimum(fired(self.white * radiance + self.dark, self.dead_ticks), 1.0))


def response_of(
    recordings: Recordings | None, shape: tuple[int, int], radiance_gain: float, dead_ticks: float = 0.0
) -> Response:
    """Return a camera's response; without recordings all pixels have the gain 1 and no dark rate, and none is bad.

    A camera may be more or less sensitive than the array: its recordings tell that too.
    """
    unit = float(fired(radiance_gain, dead_ticks))
    if recordings is None:
        ones = np.ones(shape)
        return Response(radiance_gain * ones, 0 * ones, unit, np.ones(shape, np.bool_), dead_ticks)
    found, bad = estimate(recordings), from_recordings(recordings.flat, recordings.dark)
    white, dark = found.radiance_gain * found.gain.astype(np.float64), found.dark.astype(np.float64)
    return Response(white, dark, unit, ~bad.all, dead_ticks)


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


TOLERANCE = 0.05  # radiance; a render that is 26 dB good. Far below it the darkest pixels, of long intervals, decide


@dataclass(frozen=True, eq=False)
class SpikeView:
    """What was recorded around a target, and the mean radiance in [0, 1] that a prediction has over the same time."""

    recorded: Recorded
    counted: Mapping[int, Float64]  # predicted mean radiance [H, W] over each window that has counts
    spanned: Float64 | None = None  # and over each pixel's span; None where no span was recorded
    true_spanned: Float64 | None = None  # the truth's mean over it; None where the truth is not known

    def count_error(self, window: int) -> Float64:
        """Return recorded minus predicted rate of a window [H, W], in the unit of white.

        Light above white counts as white, on both sides: a count is cut at what white gives at most.
        """
        response = self.recorded.response
        most = np.ceil(window * response.rate(np.ones_like(response.dark)))
        rate = np.minimum(self.recorded.counts[window], most) / window
        return np.asarray((rate - response.rate(self.counted[window])) / response.unit)

    @cached_property
    def span_deviance(self) -> tuple[Float64, Mask] | None:
        """The deviance of the spans [H, W], and the pixels that have one; None where no span was recorded.

        It is twice the logarithm of how much more probable the span is at the truth's rate; without truth, at its own.
        """
        spans = self.recorded.spans
        if spans is None or self.spanned is None:
            return None
        response = self.recorded.response
        intervals = np.maximum(spans.intervals, 1).astype(np.float64)
        white = response.rate(np.ones_like(response.dark))
        shortest = np.floor(intervals / np.where(white > 0, white, 1.0))  # under white; a dead pixel's is not used
        ticks = np.maximum(np.maximum(spans.last - spans.first, 1), shortest)
        own = intervals / ticks
        best = own if self.true_spanned is None else response.rate(self.true_spanned)
        law = partial(
            log_probability,
            intervals,
            ticks,
            tolerance=TOLERANCE * response.unit,
            photons=SENSOR.photons_per_spike,
        )
        known = (spans.intervals > 0) & response.good
        return 2 * (law(rate=best) - law(rate=response.rate(self.spanned))), known


def view_spikes(
    recorded: Recorded,
    ticks: Sequence[int],
    predictions: Sequence[NDArray[np.floating]],
    truths: Sequence[NDArray[np.floating]] | None,
) -> SpikeView:
    """Return what was recorded around a target beside predictions, and truths if known, at ascending ticks near it."""
    images = [_clipped(image) for image in predictions]
    counted = {length: time_mean(ticks, images, *window_around(recorded.tick, length)) for length in recorded.counts}
    if recorded.spans is None:
        return SpikeView(recorded, counted)
    # A spike falls anywhere in its tick: in the middle on average.
    start = recorded.spans.first.astype(np.float64) + 0.5
    stop = np.maximum(recorded.spans.last.astype(np.float64) + 0.5, start + 1)  # where there is no span, any will do
    truth = None if truths is None else time_mean(ticks, [_clipped(image) for image in truths], start, stop)
    return SpikeView(recorded, counted, time_mean(ticks, images, start, stop), truth)


def _clipped(image: NDArray[np.floating]) -> Float64:
    return np.clip(image.astype(np.float64), 0, 1)
