"""The rows of the metric table that judge a prediction by the spikes of the held-out camera itself.

They need what a real array has: the camera's stream, and its recordings of light and darkness where there are some.
"""

from __future__ import annotations

from functools import partial

from spike4dgs.benchmark.metrics.held_out_spikes import SPAN_WINDOW, TOLERANCE, WINDOWS
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.metric import Images, Metric, psnr_db


def _spike_psnr(window: int, dynamic: bool, pair: ImagePair) -> float | None:
    view = pair.spikes
    if view is None or window not in view.counted:
        return None
    region = view.recorded.response.good & pair.moving if dynamic else view.recorded.response.good
    if not region.any():
        return None
    return psnr_db(view.count_error(window)[region] ** 2)


def _spike_deviance(dynamic: bool, pair: ImagePair) -> float | None:
    found = pair.spikes.span_deviance if pair.spikes else None
    if found is None:
        return None
    value, known = found
    region = known & pair.moving if dynamic else known
    return float(value[region].mean()) if region.any() else None


def _psnr_row(window: int, dynamic: bool) -> Metric:
    return Metric(
        id=f"spike_psnr_{window}{'_dynamic' if dynamic else ''}",
        title=f"Spike PSNR, {window} ticks{', moving region' if dynamic else ''}",
        definition=f"10 log10(1 / MSE) of the held-out camera's own spike counts over {window} ticks against those "
        f"that follow from the predictions, in the unit of white{', over the moving region' if dynamic else ''}; "
        "the noise of counting, the same for all methods, is in it",
        higher_is_better=True,
        implementation="benchmark/metrics/held_out_spikes.py, count_error",
        measure=partial(_spike_psnr, window, dynamic),
        unit="dB",
        digits=3,
        takes="spikes",
        images=Images.RECORDED_MOVING if dynamic else Images.RECORDED,
        added_later=True,
    )


def _deviance_row(dynamic: bool) -> Metric:
    return Metric(
        id=f"spike_deviance{'_dynamic' if dynamic else ''}",
        title=f"Spike deviance{', moving region' if dynamic else ''}",
        definition=f"twice the log-likelihood that the intervals between spikes around {SPAN_WINDOW} ticks of the "
        f"held-out camera lose under the predicted rate, known to {TOLERANCE:g} of white: against the truth's rate, "
        f"where there is no truth against the recorded one; mean over the "
        f"{'moving region' if dynamic else 'pixels'}",
        higher_is_better=False,
        implementation="benchmark/metrics/held_out_spikes.py, span_deviance",
        measure=partial(_spike_deviance, dynamic),
        takes="spikes",
        images=Images.RECORDED_MOVING if dynamic else Images.RECORDED,
        added_later=True,
    )


SPIKE_METRICS: tuple[Metric, ...] = (
    *(_psnr_row(window, False) for window in WINDOWS),
    _deviance_row(False),
    *(_psnr_row(window, True) for window in WINDOWS),
    _deviance_row(True),
)
