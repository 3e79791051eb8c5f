"""From images to values: all metrics of an image, and a scene's value of each.

A scene's value is the mean of the per-image values; squared errors are never pooled over images. Images for which the
dataset defines no value (no moving region, no earlier target) are not part of the mean: they are the same for all
methods. A prediction that a metric refuses (a black image, say) takes the scene's value away, so that no method gains
by it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spike4dgs.benchmark.arrays import Mask
from spike4dgs.benchmark.errors import UserError, unknown
from spike4dgs.benchmark.metrics.image_pair import Image, ImagePair, check_images
from spike4dgs.benchmark.metrics.metric import MAX_PSNR_DB, Images, Metric
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.weights import WeightsError, find_weights

AUTO = "auto"


@dataclass(frozen=True)
class Selection:
    """Metrics to compute, each with the sha256 of the weights it uses (None: it uses none), and why not the others."""

    weights: Mapping[str, str | None]  # metric id -> sha256
    absent: Mapping[str, str]  # metric id -> reason

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """The metrics to compute, in the table's order."""
        return tuple(METRICS[i] for i in self.weights)

    def among(self, ids: Collection[str]) -> Selection:
        """Return the selection without metrics that are not in `ids`."""
        return self.without(self.weights.keys() - set(ids), _NOT_ASKED)

    def without(self, ids: Collection[str], reason: str) -> Selection:
        """Return the selection without the metrics in `ids`, for a reason."""
        kept = {i: sha256 for i, sha256 in self.weights.items() if i not in ids}
        return Selection(kept, {**self.absent, **{i: reason for i in self.weights if i in ids}})


_NOT_ASKED = "not asked for"


def select_metrics(names: Sequence[str] = (AUTO,)) -> Selection:
    """Return the metrics that a command line names: `auto` for all that this machine can compute, and metric ids.

    The metrics of linear images are always computed: they need nothing and the ranks rest on them. Raises UserError for
    unknown names, and WeightsError where a metric that is named lacks its weights.
    """
    if others := [n for n in names if n not in METRICS and n != AUTO]:
        raise unknown("--metrics", others[0], (AUTO, *METRICS), "docs/metrics.md")
    weights: dict[str, str | None] = {}
    absent: dict[str, str] = {}
    for m in METRICS.values():
        if m.takes != "linear" and m.id not in names and AUTO not in names:
            absent[m.id] = _NOT_ASKED
            continue
        try:
            weights[m.id] = find_weights(m.weights).sha256 if m.weights else None
        except WeightsError as e:
            if m.id in names:
                raise
            absent[m.id] = e.reason
    return Selection(weights, absent)


Values = dict[str, float | None]  # metric id -> value, None where there is none
_NONE = {  # there is no value for any image
    Images.EVERY: "no image has a value",
    Images.MOVING: "no image has a moving region",
    Images.COVISIBLE: "the scene has no depth of its cameras",
    Images.LATER: "no camera has two targets",
    Images.RECORDED: "no image has its ticks recorded",
    Images.RECORDED_MOVING: "no image has a moving region and its ticks recorded",
}


@dataclass(frozen=True)
class Measured:
    """Values of one image for every metric of the table, and the reasons of those that refused it."""

    values: Values
    refused: dict[str, str]


def measure(pair: ImagePair, gain: float | None, metrics: Iterable[Metric]) -> Measured:
    """Compute metrics of one image; all others are None. `gain` is the scene's (None: unknown).

    >>> truth = np.full((16, 16), 0.5)
    >>> pair = ImagePair(truth, truth + 0.1, np.ones((16, 16), bool), "example")
    >>> round(measure(pair, 1.0, [METRICS["psnr"]]).values["psnr"], 6)
    20.0
    """
    aligned = None if gain is None else replace(pair, gain=gain)
    values: Values = dict.fromkeys(METRICS)
    refused: dict[str, str] = {}
    for m in metrics:
        seen = aligned if m.aligned else pair
        try:
            values[m.id] = None if seen is None else m.measure(seen)
        except UserError as e:
            refused[m.id] = str(e).removeprefix(f"{pair.where}: ")
    return Measured(values, refused)


def score_image(
    truth: Image, prediction: Image, moving: Mask | None = None, metrics: Sequence[str] = (AUTO,)
) -> dict[str, float]:
    """Score one image and return the metrics' values by id: PSNR, SSIM and all that this machine can compute.

    truth, prediction: linear radiance [H, W], 1.0 = white; moving: the moving region [H, W] bool, for the `*_dynamic`
    metrics; metrics: as in the option `--metrics`. The `*_aligned` metrics fit their gain to this image alone. Metrics
    without a value are left out: those of a moving region or an earlier image that is not given, and those that refuse
    the image, as no-reference metrics refuse an even one. Raises UserError for images that do not fit together.

    >>> truth = np.full((16, 16), 0.5)
    >>> round(score_image(truth, truth + 0.1, metrics=["psnr"])["psnr"], 6)
    20.0
    """
    region = np.zeros(truth.shape, np.bool_) if moving is None else moving
    check_images(truth, prediction, region, "image")
    pair = ImagePair(truth, prediction, region, "image")
    values = measure(pair, fit_gain([(truth, prediction)]), select_metrics(metrics).metrics).values
    return {metric: value for metric, value in values.items() if value is not None}


def fit_gain(pairs: Iterable[tuple[Image, Image]]) -> float | None:
    """Return the gain g that minimises sum (g * prediction - truth)^2 over (truth, prediction) pairs, before clipping.

    None where no positive gain does (predictions all zero, or of the wrong sign).
    """
    cross = power = 0.0
    for truth, prediction in pairs:
        p = prediction.astype(np.float64)
        cross += float(np.sum(p * truth))
        power += float(np.sum(p * p))
    return cross / power if power > 0 and cross > 0 else None


def mean(values: Iterable[float | None]) -> float | None:
    """Return the mean; None where a value is missing, and for no values."""
    found = list(values)
    known = [v for v in found if v is not None]
    return math.fsum(known) / len(known) if known and len(known) == len(found) else None


def scene_means(per_image: Mapping[str, Mapping[str, float | None]]) -> Values:
    """Return each metric's mean over the images (camera/tick) for which it is defined; None if one lacks a value."""
    means: Values = {}
    later = _later(per_image)
    for m in METRICS.values():
        values = {name: image[m.id] for name, image in per_image.items()}
        if m.images not in (Images.EVERY, Images.LATER):  # these refuse nothing: no value means that none is defined
            values = {name: v for name, v in values.items() if v is not None}
        elif m.images is Images.LATER:
            values = {name: v for name, v in values.items() if name in later}
        means[m.id] = mean(values.values())
    return means


def scene_notes(
    per_image: Mapping[str, Mapping[str, float | None]],
    refused: Mapping[str, Mapping[str, str]],
    selection: Selection,
) -> dict[str, str]:
    """Return a note for every scene value that needs one: why it is null, which images it covers, which were capped.

    `refused` has the reasons by image name and metric. Where users choose the weights, the note has their hash.
    """
    notes: dict[str, str] = {}
    for m in METRICS.values():
        if m.id in selection.absent:
            notes[m.id] = f"not computed: {selection.absent[m.id]}"
            continue
        reasons = {name: r[m.id] for name, r in refused.items() if m.id in r}
        values = {name: v for name, image in per_image.items() if (v := image[m.id]) is not None}
        free = m.weights is not None and m.weights.sha256 is None
        weights = f"weights with sha256 {selection.weights[m.id]}" if free else ""
        if text := "; ".join(filter(None, (_coverage(m, per_image, values, reasons), _capped(m, values), weights))):
            notes[m.id] = text
    return notes


def _coverage(
    m: Metric,
    per_image: Mapping[str, Mapping[str, float | None]],
    values: Mapping[str, float],
    reasons: Mapping[str, str],
) -> str:
    """Return why there is no value, or which images have one; an empty string where all have."""
    if reasons:
        name, reason = next(iter(reasons.items()))
        return f"{len(reasons)} of {len(per_image)} images refused, the first {name}: {reason}"
    if values:
        everything = len(values) == len(per_image)
        return "" if everything else f"mean over the {len(values)} of {len(per_image)} {m.images.value}"
    if m.aligned and any(image[m.id.removesuffix("_aligned")] is not None for image in per_image.values()):
        return "no positive gain fits the predictions"
    return _NONE[m.images]


def _capped(m: Metric, values: Mapping[str, float]) -> str:
    capped = [name for name, v in values.items() if m.unit == "dB" and v >= MAX_PSNR_DB]
    return f"{len(capped)} without any error count as {MAX_PSNR_DB:g} dB, the first {capped[0]}" if capped else ""


def _later(names: Iterable[str]) -> set[str]:
    """Return the names (camera/tick) without the first of each camera."""
    everything = set(names)
    cameras: dict[str, list[str]] = {}
    for name in everything:
        cameras.setdefault(name.rpartition("/")[0], []).append(name)
    return everything - {min(group, key=lambda n: (len(n), n)) for group in cameras.values()}
