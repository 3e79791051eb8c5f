"""The metric table, which the scorer, the command line, the leaderboard and the docs read.

A metric takes one of three kinds of input:

- `linear`: gray linear radiance in the dataset's known unit (1.0 = white), clipped to [0, 1]: no gamma, no scaling.
- `srgb8`: the same image sRGB-encoded with 8 bits, as shown to people: for perceptual and no-reference metrics.
- `spikes`: linear radiance beside the spikes that the held-out camera itself recorded; no image of the truth.

The `*_aligned` metrics multiply the prediction by one least-squares gain per scene, which forgives a method that does
not know the exposure. The `*_dynamic` metrics use only the moving region that the dataset marks; `psnr_covisible`
leaves out what fewer than two training cameras see. Metrics of linear
images are always computed. The others are computed where the machine has their weights, or only those asked for.

JSON has no infinity: identical images, whose PSNR is infinite, count as `MAX_PSNR_DB`, and the record says so.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spike4dgs.benchmark.arrays import Mask
from spike4dgs.benchmark.metrics.covisible import CAMERAS
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.lpips import TRUNKS, lpips
from spike4dgs.benchmark.metrics.metric import MAX_PSNR_DB, Images, Metric, psnr_db
from spike4dgs.benchmark.metrics.spike_rows import SPIKE_METRICS
from spike4dgs.benchmark.metrics.ssim_window import SSIM_SIGMA, SSIM_WINDOW
from spike4dgs.benchmark.screen.shown import Table
from spike4dgs.benchmark.weights import METAIQA


def _psnr(pair: ImagePair) -> float:
    from skimage.metrics import peak_signal_noise_ratio

    with np.errstate(divide="ignore"):  # identical images: infinity, capped
        value = peak_signal_noise_ratio(pair.truth, pair.prediction, data_range=1)  # type: ignore[no-untyped-call]
    return min(float(value), MAX_PSNR_DB)


def _psnr_dynamic(pair: ImagePair) -> float | None:
    return _psnr_in(pair, pair.moving)


def _psnr_covisible(pair: ImagePair) -> float | None:
    return None if pair.covisible is None else _psnr_in(pair, pair.covisible | pair.moving)


def _psnr_in(pair: ImagePair, region: Mask) -> float | None:
    return psnr_db((pair.truth[region] - pair.prediction[region]) ** 2) if region.any() else None


def _ssim_dynamic(pair: ImagePair) -> float | None:
    return float(pair.ssim[1][pair.moving].mean()) if pair.moving.any() else None


def _temporal_error(pair: ImagePair) -> float | None:
    if pair.earlier is None:
        return None
    pair.check_image()
    pair.earlier.check_image()
    change = (pair.prediction - pair.earlier.prediction) - (pair.truth - pair.earlier.truth)
    return float(np.mean(np.abs(change))) / pair.since_ms


def _flip(pair: ImagePair) -> float:
    from spike4dgs.benchmark.metrics.flip import flip

    return flip(pair.truth8, pair.prediction8)


def _brisque(pair: ImagePair) -> float:
    from spike4dgs.benchmark.metrics.iqa.brisque import brisque

    pair.check_image()
    return brisque(pair.prediction8, pair.where)


def _niqe(pair: ImagePair) -> float:
    from spike4dgs.benchmark.metrics.iqa.niqe import niqe

    pair.check_image()
    return niqe(pair.prediction8, pair.where)


def _metaiqa(pair: ImagePair) -> float:
    from spike4dgs.benchmark.metrics.iqa.metaiqa import metaiqa

    pair.check_image()
    return metaiqa(pair.prediction8)


_PSNR_CALL = "skimage.metrics.peak_signal_noise_ratio(truth, prediction, data_range=1)"
_SSIM_CALL = (
    f"skimage.metrics.structural_similarity(truth, prediction, gaussian_weights=True, sigma={SSIM_SIGMA:g}, "
    "use_sample_covariance=False, data_range=1)"
)
_BASE = (
    Metric(
        id="psnr",
        title="PSNR",
        definition=f"10 log10(1 / MSE) over all pixels; identical images count as {MAX_PSNR_DB:g} dB",
        higher_is_better=True,
        implementation=_PSNR_CALL,
        measure=_psnr,
        unit="dB",
        digits=2,
    ),
    Metric(
        id="ssim",
        title="SSIM",
        definition=f"structural similarity, {SSIM_WINDOW}x{SSIM_WINDOW} Gaussian window with sigma {SSIM_SIGMA:g}, "
        "data range 1, mean over the image",
        higher_is_better=True,
        implementation=_SSIM_CALL,
        measure=lambda pair: pair.ssim[0],
    ),
    Metric(
        id="psnr_dynamic",
        title="PSNR, moving region",
        definition=f"10 log10(1 / MSE) over the pixels of the moving region; no error counts as {MAX_PSNR_DB:g} dB",
        higher_is_better=True,
        implementation="-10 * log10(mean((truth - prediction)[moving] ** 2))",
        measure=_psnr_dynamic,
        unit="dB",
        digits=2,
        images=Images.MOVING,
    ),
    Metric(
        id="ssim_dynamic",
        title="SSIM, moving region",
        definition="mean over the moving region of the SSIM map of the whole image",
        higher_is_better=True,
        implementation=_SSIM_CALL.replace("data_range=1)", "data_range=1, full=True)[1][moving].mean()"),
        measure=_ssim_dynamic,
        images=Images.MOVING,
    ),
)
_COVISIBLE = Metric(
    id="psnr_covisible",
    title="PSNR, co-visible",
    definition=f"10 log10(1 / MSE) over the pixels that {CAMERAS} or more training cameras see, by the scene's depth "
    f"maps, and those of the moving region; no error counts as {MAX_PSNR_DB:g} dB",
    higher_is_better=True,
    implementation="-10 * log10(mean((truth - prediction)[covisible | moving] ** 2)); benchmark/metrics/covisible.py",
    measure=_psnr_covisible,
    unit="dB",
    digits=2,
    images=Images.COVISIBLE,
    added_later=True,
)


def _aligned(m: Metric) -> Metric:
    return replace(
        m,
        id=f"{m.id}_aligned",
        title=f"{m.title}, gain fitted",
        definition=f"{m.definition}; the prediction is first multiplied by the scene's least-squares gain",
        implementation=m.implementation.replace("prediction", "gain * prediction"),
        aligned=True,
    )


def _lpips_metric(net: str, title: str) -> Metric:
    return Metric(
        id=f"lpips_{net}",
        title=f"LPIPS, {title}",
        definition=f"learned perceptual distance, version 0.1, of {title} features; gray repeated to three channels",
        higher_is_better=False,
        implementation=f"benchmark/metrics/lpips.py; equals lpips 0.1.4, LPIPS(net='{net}'), "
        f"with the weights {TRUNKS[net].name}",
        measure=lambda pair: lpips(net, pair.truth8, pair.prediction8),
        takes="srgb8",
        weights=TRUNKS[net],
        tolerance=1e-4,  # float32 convolutions, summed in another order by every library
    )


_PERCEPTUAL = (
    _lpips_metric("alex", "AlexNet"),
    _lpips_metric("vgg", "VGG-16"),
    _lpips_metric("squeeze", "SqueezeNet 1.1"),
    Metric(
        id="flip",
        title="FLIP",
        definition="mean visible error when truth and prediction alternate on a screen with 67.02 pixels per degree",
        higher_is_better=False,
        implementation="benchmark/metrics/flip.py; equals flip-evaluator 1.7, evaluate(truth, prediction, 'LDR'), "
        "gray as three channels",
        measure=_flip,
        takes="srgb8",
    ),
    Metric(
        id="brisque",
        title="BRISQUE",
        definition="no-reference score by natural scene statistics and the LIVE release's regression; not bounded",
        higher_is_better=False,
        implementation="benchmark/metrics/iqa/brisque.py; follows the authors' MATLAB release, "
        "not MATLAB's own brisque",
        measure=_brisque,
        digits=2,
        takes="srgb8",
        blind=True,
        tolerance=1e-4,
    ),
    Metric(
        id="niqe",
        title="NIQE",
        definition="no-reference distance to the statistics of pristine photographs; not comparable across image sizes",
        higher_is_better=False,
        implementation="benchmark/metrics/iqa/niqe.py; follows the authors' MATLAB release, not MATLAB's own niqe",
        measure=_niqe,
        digits=3,
        takes="srgb8",
        blind=True,
        tolerance=1e-4,
    ),
    Metric(
        id="metaiqa",
        title="MetaIQA",
        definition="no-reference score in 0..1 of a ResNet-18; depends on the weights, whose hash is in the record",
        higher_is_better=True,
        implementation=f"benchmark/metrics/iqa/metaiqa.py with the user's {METAIQA.name}",
        measure=_metaiqa,
        takes="srgb8",
        blind=True,
        weights=METAIQA,
        tolerance=1e-4,
    ),
    Metric(
        id="temporal_error",
        title="Temporal error",
        definition="mean over pixels of |d prediction/dt - d truth/dt| between consecutive targets of a camera; "
        "a prediction that never changes scores the mean |d truth/dt|",
        higher_is_better=False,
        implementation="mean(|(prediction - earlier prediction) - (truth - earlier truth)|) / "
        "(milliseconds between them)",
        measure=_temporal_error,
        unit="1/ms",
        images=Images.LATER,
    ),
)

METRICS: dict[str, Metric] = Table(
    "metrics", {m.id: m for m in (*_BASE, *map(_aligned, _BASE), _COVISIBLE, *_PERCEPTUAL, *SPIKE_METRICS)}
)
PRIMARY = "psnr"  # what the leaderboard ranks by
MAIN = ("psnr", "ssim", "psnr_dynamic", "ssim_dynamic", "flip")  # what a short table or line shows
