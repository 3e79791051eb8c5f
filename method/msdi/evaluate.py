"""Scores of MSDI on data that it was not trained on: images, points, confidence and poses, against the truth.

Names and units of `Scores.measured`:

- `psnr_db`, `psnr_dynamic_db`: of the images, mean over views; `raw_...`: of those without knowledge of the sensors;
  `tfp_...`: of the mean of the same window's spikes, as they are; `tfp_flat_...`: corrected for the sensors.
- `point_error`, `point_error_median`: |X / z - Xgt / zgt| of all pixels that see something, z the mean distance of a
  sample's points; so 0.1 is a tenth of the scene's size. `point_error_confident`: of the half that is most certain.
- `confidence_rank`: Spearman's correlation of the expected error, alpha / C, with the true one; 1 is a perfect order.
  (The loss C error - alpha log C is smallest at alpha / C = error, so this is the error that C predicts.)
- `calibration`: mean |ln(true / expected error)| over ten groups of equal size by expected error; 0 is calibrated.
- `rotation_deg`, `direction_deg`: medians over all views but the first; a view without a pose counts as 180 degrees.
- `rra_5`, `rta_5`: shares of those views within 5 degrees. `posed`: share that has a pose at all.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import spearmanr
from torch import Tensor

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.pose_error import angle_deg
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.method.msdi.inputs import Sensors
from spike4dgs.method.msdi.losses import ALPHA, normalized
from spike4dgs.method.msdi.network import Estimate, Msdi
from spike4dgs.method.msdi.pose import poses_of
from spike4dgs.method.msdi.training_data import Batch

GROUPS = 10
_POINTS = 10_000  # pixels of a sample that are compared
_CLOSE_DEG = 5.0
_SMALLEST = 1e-9


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of a network."""

    measured: dict[str, float]  # see the module
    calibration: Float64 | None  # [GROUPS, 2] mean expected and mean true error, by rising expected error


def evaluate(network: Msdi, batches: Iterable[Batch], device: str) -> Scores:
    """Return the scores of the network on batches; intrinsics and sensors are known."""
    was_training = network.training
    network.eval()
    images, points, poses = [], [], []
    with torch.inference_mode():
        for batch in batches:
            spikes, intrinsics, sensitivity, dark = (
                torch.from_numpy(a).to(device) for a in (batch.spikes, batch.intrinsics, batch.sensitivity, batch.dark)
            )
            found = network(spikes, intrinsics, Sensors(sensitivity, dark))
            raw = network.images(spikes.flatten(0, 1)).unflatten(0, spikes.shape[:2])
            images += _images(found.images, raw, batch)
            points.append(_point_errors(found, batch))
            poses += _pose_errors(found, batch)
    network.train(was_training)
    expected, true = np.concatenate(points).T
    groups = calibrate(expected, true)
    rotation, direction = np.array(poses).T
    measured = {
        **_means(images),
        "point_error": float(true.mean()),
        "point_error_median": float(np.median(true)),
        "point_error_confident": float(true[expected <= np.median(expected)].mean()),
        "confidence_rank": _rank_correlation(expected, true),
        "calibration": float(np.abs(np.log(groups[:, 1] / groups[:, 0])).mean()),
        "rotation_deg": float(np.median(rotation)),
        "direction_deg": float(np.median(direction)),
        "rra_5": float(np.mean(rotation < _CLOSE_DEG)),
        "rta_5": float(np.mean(direction < _CLOSE_DEG)),
        "posed": float(np.mean(rotation < 180)),
    }
    return Scores(measured, groups)


def calibrate(expected: Float64, true: Float64) -> Float64:
    """Return the mean expected and true errors [GROUPS, 2] of groups of equal size, by rising expected error [N]."""
    order = np.argsort(expected, kind="stable")
    parts = np.array_split(order, GROUPS)
    return np.array([[max(float(x[part].mean()), _SMALLEST) for x in (expected, true)] for part in parts])


def tfp(spikes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return spikes per tick of windows [..., T, H, W], T odd: the mean of the T - 1 ticks around the instant."""
    return np.asarray(spikes[..., :-1, :, :].mean(axis=-3), np.float32)


def _images(images: Tensor, raw: Tensor, batch: Batch) -> list[dict[str, float]]:
    """Return the scores of each view."""
    mean = tfp(batch.spikes)
    flat = (mean - batch.dark) / batch.sensitivity
    made = {"": images.cpu().numpy(), "raw_": raw.cpu().numpy(), "tfp_": mean, "tfp_flat_": flat}
    found = []
    for b, v in np.ndindex(batch.rate.shape[:2]):
        row = {}
        for prefix, rates in made.items():
            truth, image = batch.rate[b, v] / batch.gain, rates[b, v] / batch.gain
            pair = ImagePair(truth, image, batch.moving[b, v], f"sample {b}, view {v}")
            for name in ("psnr", "psnr_dynamic"):
                if (value := METRICS[name].measure(pair)) is not None:
                    row[f"{prefix}{name}_db"] = value
        found.append(row)
    return found


def _means(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each name over the rows that have it."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}


def _point_errors(found: Estimate, batch: Batch) -> Float64:
    """Return the expected and true errors [N, 2] of pixels that see something, evenly chosen."""
    truth = torch.from_numpy(batch.points)
    counted = truth.isfinite().all(dim=-1)
    off = normalized(found.points.cpu(), counted) - normalized(truth.nan_to_num(1.0), counted)
    true = torch.linalg.vector_norm(off, dim=-1)[counted]
    both = torch.stack([ALPHA / found.confidence.cpu()[counted], true], dim=1)
    return both[:: max(1, len(both) // _POINTS)].double().numpy()


def _pose_errors(found: Estimate, batch: Batch) -> list[tuple[float, float]]:
    """Return the errors in degrees, of rotation and of direction to the camera, of all but each sample's first view."""
    errors = []
    for views, truth in zip(poses_of(found, batch.intrinsics.astype(np.float64)), batch.w2c, strict=True):
        for view, true in zip(views[1:], truth[1:], strict=True):
            if view.w2c is None:
                errors.append((180.0, 180.0))
                continue
            turn = angle_deg(view.w2c[:3, :3] @ true[:3, :3].T)
            a, b = (-m[:3, :3].T @ m[:3, 3] for m in (view.w2c, true))
            between = np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
            errors.append((float(turn), float(between)))
    return errors


def _rank_correlation(a: Float64, b: Float64) -> float:
    """Return Spearman's correlation; 0 if one of them is constant."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return 0.0
    return float(spearmanr(a, b).statistic)
