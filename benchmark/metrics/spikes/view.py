"""A target beside the spikes that the held-out camera recorded around it, for the metrics of spikes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.metrics.spikes.law import log_probability
from spike4dgs.benchmark.metrics.spikes.recorded import Float64, Mask, Recorded, window_around
from spike4dgs.benchmark.metrics.spikes.time_mean import time_mean
from spike4dgs.benchmark.spikes.sensor_model import SENSOR

TOLERANCE = 0.05  # radiance; a render that is 26 dB good. Far below it the darkest pixels, of long intervals, decide


@dataclass(frozen=True, eq=False)
class SpikeView:
    """What was recorded around a target, and the mean radiance in [0, 1] that a prediction has over the same time.

    Attributes:
        recorded: counts and spans.
        counted: predicted mean radiance [H, W] over each window that has counts.
        spanned: predicted mean radiance over each pixel's span; None where no span was recorded.
        true_spanned: the truth's mean over it; None where the truth is not known.
    """

    recorded: Recorded
    counted: Mapping[int, Float64]
    spanned: Float64 | None = None
    true_spanned: Float64 | None = None

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
        shortest = np.floor(intervals / response.rate(np.ones_like(response.dark)))  # under white
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
