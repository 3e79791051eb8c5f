"""The metric table, which the scorer, the command line, the leaderboard and the docs read.

Two kinds of input, and the table says which a metric takes:

- `linear`: gray linear radiance in the dataset's known unit (1.0 = white), clipped to [0, 1]: no gamma, no scaling.
- `srgb8`: the same image sRGB-encoded with 8 bits, as people see it: for perceptual and no-reference metrics.

The `*_aligned` metrics see the prediction times one least-squares gain per scene, which forgives a method that does not
know the exposure. The `*_dynamic` ones look only at the moving region that the dataset marks. Metrics of linear images
are always computed. Of the others, those are that the machine has weights for, or those that were asked for by name.

JSON has no infinity: identical images, whose PSNR is infinite, count as `MAX_PSNR_DB`, and the record says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from typing import Literal

import numpy as np

from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.lpips import TRUNKS, lpips
from spike4dgs.benchmark.weights import METAIQA, WeightFile

MAX_PSNR_DB = 100.0  # half-float images with any error at all stay far below it


class Images(Enum):
    """The images of a scene that have a value. The dataset alone decides that, so they are the same for all methods."""

    EVERY = "images"
    MOVING = "images that have a moving region"
    LATER = "images that have an earlier one of their camera"


@dataclass(frozen=True)
class Metric:
    """One row of the table. `measure` maps an image pair to a value, or to None where the dataset defines none.

    It raises UserError for a prediction that the metric refuses: no value of the scene then.
    """

    id: str
    title: str
    definition: str
    higher_is_better: bool
    implementation: str
    measure: Callable[[ImagePair], float | None]
    unit: str
    digits: int  # decimals shown to people; records keep the full value
    takes: Literal["linear", "srgb8"] = "linear"
    images: Images = Images.EVERY
    weights: WeightFile | None = None  # a file that users bring; None: always computable
    aligned: bool = False  # the prediction is first multiplied by the scene's gain
    blind: bool = False  # it does not look at the truth, so the truth has a score of its own
    tolerance: float = 1e-6  # how far the same files' values may lie apart on two machines

    def format(self, value: float | None) -> str:
        """The value as people read it; a dash for null."""
        return "-" if value is None else f"{value:.{self.digits}f}"


def _psnr(pair: ImagePair) -> float:
    from skimage.metrics import peak_signal_noise_ratio

    with np.errstate(divide="ignore"):  # identical images: infinity, capped
        value = peak_signal_noise_ratio(pair.truth, pair.prediction, data_range=1)  # type: ignore[no-untyped-call]
    return min(float(value), MAX_PSNR_DB)


def _psnr_dynamic(pair: ImagePair) -> float | None:
    if not pair.moving.any():
        return None
    mse = float(np.mean((pair.truth[pair.moving] - pair.prediction[pair.moving]) ** 2))
    return min(-10 * math.log10(mse), MAX_PSNR_DB) if mse > 0 else MAX_PSNR_DB


def _ssim(pair: ImagePair) -> float:
    return pair.ssim[0]


def _ssim_dynamic(pair: ImagePair) -> float | None:
    return float(pair.ssim[1][pair.moving].mean()) if pair.moving.any() else None


def _temporal_error(pair: ImagePair) -> float | None:
    if pair.earlier is None:
        return None
    pair.check_image()
    pair.earlier.check_image()
    change = (pair.prediction - pair.earlier.prediction) - (pair.truth - pair.earlier.truth)
    return float(np.mean(np.abs(change))) / pair.since_ms


def _lpips(net: str, pair: ImagePair) -> float:
    return lpips(net, pair.truth8, pair.prediction8)


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
    "skimage.metrics.structural_similarity(truth, prediction, gaussian_weights=True, sigma=1.5, "
    "use_sample_covariance=False, data_range=1)"
)
_BASE = (
    Metric(
        "psnr",
        "PSNR",
        f"10 log10(1 / MSE) over all pixels; identical images count as {MAX_PSNR_DB:g} dB",
        True,
        _PSNR_CALL,
        _psnr,
        "dB",
        2,
    ),
    Metric(
        "ssim",
        "SSIM",
        "structural similarity, 11x11 Gaussian window with sigma 1.5, data range 1, mean over the image",
        True,
        _SSIM_CALL,
        _ssim,
        "",
        4,
    ),
    Metric(
        "psnr_dynamic",
        "PSNR, moving region",
        f"10 log10(1 / MSE) over the pixels of the moving region; no error counts as {MAX_PSNR_DB:g} dB",
        True,
        "-10 * log10(mean((truth - prediction)[moving] ** 2))",
        _psnr_dynamic,
        "dB",
        2,
        images=Images.MOVING,
    ),
    Metric(
        "ssim_dynamic",
        "SSIM, moving region",
        "mean over the moving region of the SSIM map of the whole image",
        True,
        _SSIM_CALL.replace("data_range=1)", "data_range=1, full=True)[1][moving].mean()"),
        _ssim_dynamic,
        "",
        4,
        images=Images.MOVING,
    ),
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
        f"lpips_{net}",
        f"LPIPS, {title}",
        f"learned perceptual distance, version 0.1, of {title} features; gray repeated to three channels",
        False,
        f"benchmark/metrics/lpips.py; equals lpips 0.1.4, LPIPS(net='{net}'), with the weights {TRUNKS[net].name}",
        partial(_lpips, net),
        "",
        4,
        takes="srgb8",
        weights=TRUNKS[net],
        tolerance=1e-4,  # float32 convolutions, summed in another order by every library
    )


_PERCEPTUAL = (
    _lpips_metric("alex", "AlexNet"),
    _lpips_metric("vgg", "VGG-16"),
    _lpips_metric("squeeze", "SqueezeNet 1.1"),
    Metric(
        "flip",
        "FLIP",
        "mean visible error when truth and prediction alternate on a screen with 67.02 pixels per degree",
        False,
        "benchmark/metrics/flip.py; equals flip-evaluator 1.7, evaluate(truth, prediction, 'LDR'), "
        "gray as three channels",
        _flip,
        "",
        4,
        takes="srgb8",
    ),
    Metric(
        "brisque",
        "BRISQUE",
        "no-reference score by natural scene statistics and the LIVE release's regression; not bounded",
        False,
        "benchmark/metrics/iqa/brisque.py; follows the authors' MATLAB release, not MATLAB's own brisque",
        _brisque,
        "",
        2,
        takes="srgb8",
        blind=True,
        tolerance=1e-4,
    ),
    Metric(
        "niqe",
        "NIQE",
        "no-reference distance to the statistics of pristine photographs; not comparable across image sizes",
        False,
        "benchmark/metrics/iqa/niqe.py; follows the authors' MATLAB release, not MATLAB's own niqe",
        _niqe,
        "",
        3,
        takes="srgb8",
        blind=True,
        tolerance=1e-4,
    ),
    Metric(
        "metaiqa",
        "MetaIQA",
        "no-reference score in 0..1 of a ResNet-18; depends on the weights, whose hash is in the record",
        True,
        f"benchmark/metrics/iqa/metaiqa.py with the user's {METAIQA.name}",
        _metaiqa,
        "",
        4,
        takes="srgb8",
        blind=True,
        weights=METAIQA,
        tolerance=1e-4,
    ),
    Metric(
        "temporal_error",
        "Temporal error",
        "mean over pixels of |d prediction/dt - d truth/dt| between consecutive targets of a camera; a prediction "
        "that never changes scores the mean |d truth/dt|",
        False,
        "mean(|(prediction - earlier prediction) - (truth - earlier truth)|) / (milliseconds between them)",
        _temporal_error,
        "1/ms",
        4,
        images=Images.LATER,
    ),
)

METRICS: dict[str, Metric] = {m.id: m for m in (*_BASE, *map(_aligned, _BASE), *_PERCEPTUAL)}
PRIMARY = "psnr"  # what the leaderboard ranks by
