"""Image metrics: one table that the scorer, the command line, the leaderboard and the docs read.

All metrics see gray linear radiance in the dataset's known unit (1.0 = white), clipped to [0, 1]: no gamma, no min-max
scaling. The `*_aligned` ones see the prediction times one least-squares gain per scene, which forgives a method that
does not know the exposure. The `*_dynamic` ones look only at the moving region that the dataset marks.

A scene's value is the mean of the per-image values; squared errors are never pooled over images. JSON has no infinity:
identical images, whose PSNR is infinite, count as `MAX_PSNR_DB`, and the record says so. An image without a moving
region has no dynamic value (null) and is not part of the mean: the dataset decides that, so it is the same for all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem

Image = NDArray[np.floating]
Mask = NDArray[np.bool_]
Values = dict[str, float | None]  # metric id -> value, None where there is none
MAX_PSNR_DB = 100.0  # half-float images with any error at all stay far below it
WINDOW = 11  # pixels; the side of SSIM's Gaussian window (sigma 1.5, cut off at 3.5 sigma)


@dataclass(frozen=True, eq=False)
class ImagePair:
    """What a metric sees: truth and prediction [H, W] float64 in [0, 1], and the moving region [H, W] bool."""

    truth: NDArray[np.float64]
    prediction: NDArray[np.float64]
    moving: Mask

    @cached_property
    def ssim(self) -> tuple[float, NDArray[np.float64]]:
        """Mean SSIM and the map [H, W] it comes from (the mean leaves out a border of half a window)."""
        from skimage.metrics import structural_similarity

        value, ssim_map = structural_similarity(  # type: ignore[no-untyped-call]
            self.truth,
            self.prediction,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
            data_range=1,
            full=True,
        )
        return float(value), np.asarray(ssim_map)


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


@dataclass(frozen=True)
class Metric:
    """One row of the table. `measure` maps an image pair to a value, or to None where the metric is undefined."""

    id: str
    title: str
    definition: str
    higher_is_better: bool
    implementation: str
    measure: Callable[[ImagePair], float | None]
    unit: str
    digits: int  # decimals shown to people; records keep the full value
    aligned: bool = False  # the prediction is first multiplied by the scene's gain

    def format(self, value: float | None) -> str:
        """The value as people read it; a dash for null."""
        return "-" if value is None else f"{value:.{self.digits}f}"


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
    ),
)


def _aligned(m: Metric) -> Metric:
    definition = f"{m.definition}; the prediction is first multiplied by the scene's least-squares gain"
    implementation = m.implementation.replace("prediction", "gain * prediction")
    return Metric(
        f"{m.id}_aligned",
        f"{m.title}, gain fitted",
        definition,
        m.higher_is_better,
        implementation,
        m.measure,
        m.unit,
        m.digits,
        aligned=True,
    )


METRICS: dict[str, Metric] = {m.id: m for m in (*_BASE, *map(_aligned, _BASE))}
PRIMARY = "psnr"  # what the leaderboard ranks by


def measure(truth: Image, prediction: Image, moving: Mask, gain: float | None, where: str) -> Values:
    """All metrics of one image: {metric id: value, or None where it is undefined}.

    truth and prediction are linear radiance [H, W], moving is [H, W] bool, gain is the scene's (None: unknown).
    Raises UserError, with `where` as the image's name, for arrays that are no such images.

    >>> truth = np.full((16, 16), 0.5)
    >>> round(measure(truth, truth + 0.1, np.ones((16, 16), bool), 1.0, "example")["psnr"], 6)
    20.0
    """
    check_images(truth, prediction, moving, where)
    raw = _pair(truth, prediction, moving, 1.0)
    aligned = None if gain is None else _pair(truth, prediction, moving, gain)
    values: Values = {}
    for m in METRICS.values():
        pair = aligned if m.aligned else raw
        values[m.id] = None if pair is None else m.measure(pair)
    return values


def scene_means(per_image: Mapping[str, Mapping[str, float | None]]) -> tuple[Values, dict[str, str]]:
    """Mean over images of each metric, and a note for every value that needs one.

    A metric without any value is None. The notes say why, where images without a moving region are left out, and where
    a value was capped.
    """
    means: Values = {}
    notes: dict[str, str] = {}
    for m in METRICS.values():
        values = {name: v for name, image in per_image.items() if (v := image[m.id]) is not None}
        means[m.id] = math.fsum(values.values()) / len(values) if values else None
        capped = [name for name, v in values.items() if m.unit == "dB" and v >= MAX_PSNR_DB]
        if not values:
            no_gain = m.aligned and any(
                image[m.id.removesuffix("_aligned")] is not None for image in per_image.values()
            )
            notes[m.id] = "no positive gain fits the predictions" if no_gain else "no image has a moving region"
        elif len(values) < len(per_image):
            notes[m.id] = f"mean over the {len(values)} of {len(per_image)} images that have a moving region"
        if capped:
            text = f"{len(capped)} without any error count as {MAX_PSNR_DB:g} dB, the first {capped[0]}"
            notes[m.id] = "; ".join(filter(None, (notes.get(m.id), text)))
    return means, notes


def check_images(truth: Image, prediction: Image, moving: Mask, where: str) -> None:
    """Raise UserError unless the arrays are finite float images of one size, at least SSIM's window, and a mask."""
    if prediction.ndim != 2 or prediction.shape != truth.shape:
        raise problem(where, f"a gray image of shape {truth.shape}", f"shape {prediction.shape}", "render that size")
    if min(truth.shape) < WINDOW:
        raise problem(where, f"at least {WINDOW}x{WINDOW} pixels", f"{truth.shape}", "use a larger image")
    for name, image in (("truth", truth), ("prediction", prediction)):
        if not np.issubdtype(image.dtype, np.floating):
            raise problem(where, f"a {name} in floating point", str(image.dtype), "store linear radiance, 1.0 = white")
        if bad := int(np.count_nonzero(~np.isfinite(image))):
            raise problem(where, f"a finite {name}", f"{bad} pixels that are not", "correct the program that wrote it")
    if moving.shape != truth.shape or moving.dtype != np.bool_:
        found = f"{moving.dtype} {moving.shape}"
        raise problem(where, f"a bool mask of shape {truth.shape}", found, "restore the scene's mask")


def fit_gain(pairs: Iterable[tuple[Image, Image]]) -> float | None:
    """The gain g that minimises sum (g * prediction - truth)^2 over a scene's (truth, prediction), before clipping.

    None where no positive gain does (predictions all zero, or of the wrong sign).
    """
    cross = power = 0.0
    for truth, prediction in pairs:
        p = prediction.astype(np.float64)
        cross += float(np.sum(p * truth))
        power += float(np.sum(p * p))
    return cross / power if power > 0 and cross > 0 else None


def _pair(truth: Image, prediction: Image, moving: Mask, gain: float) -> ImagePair:
    shown = np.clip(gain * prediction.astype(np.float64), 0, 1)
    return ImagePair(np.clip(truth.astype(np.float64), 0, 1), shown, moving)
