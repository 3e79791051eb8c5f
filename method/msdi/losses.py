"""The numbers of MSDI's training, each with its reason, and its losses: L1 on images, confidence-weighted points."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from spike4dgs.method.gaussians.optimizer import WarmCosine

PUBLISHED: dict[str, float] = {"lr_points": 1e-4}  # the publication states no more of its training than the losses


@dataclass(frozen=True)
class TrainingSettings:
    """Hyper-parameters."""

    steps: int = 20_000
    views: int = 8  # of a step: samples times views of a sample
    most_views: int = 8  # of a sample; at least two
    lr_points: float = PUBLISHED["lr_points"]  # Adam's, after the warm-up; it falls to 0 with the cosine
    lr_images: float = 1e-3  # the same of extractor and generator, which are small
    warm_up: int = 500  # steps
    unknown_share: float = 0.2  # of the steps, without intrinsics
    raw_share: float = 0.2  # of the steps, without sensors
    score_every: int = 1000  # steps

    def learning_rates(self, step: int) -> dict[str, float]:
        """Return Adam's learning rates of the two groups at a step."""
        peaks = {"images": self.lr_images, "points": self.lr_points}
        return {name: WarmCosine(peak, self.warm_up, self.steps).at(step) for name, peak in peaks.items()}


ALPHA = 0.2  # weight of the confidence's logarithm, DUSt3R's
_SMALLEST = 1e-8  # of a mean distance


def image_loss(images: Tensor, truth: Tensor) -> Tensor:
    """Return the mean |image - truth| over the pixels whose truth is finite; 0 if there is none.

    `images` and `truth` have the same shape, in spikes per tick.
    """
    counted = truth.isfinite()
    # Replaced before the difference: a NaN that is masked afterwards still has a gradient of NaN.
    difference = (images - truth.where(counted, images.detach())).abs()
    return _mean(difference, counted)


def point_loss(points: Tensor, confidence: Tensor, truth: Tensor) -> Tensor:
    """Return DUSt3R's loss (eqs. 3 and 4 there) over V views: the mean of C |X / z - Xgt / zgt| - alpha log C.

    `points` and `truth` [B, V, H, W, 3] are in view 0's frame; `confidence` C > 1 is [B, V, H, W]. Points whose truth
    is not finite never count. z and zgt are the mean distances of a sample's points to the origin, over all its views
    together: each network output may have a scale of its own, and the views of a sample share one. The mean is over
    the batch; 0 if no point counts.
    """
    counted = truth.isfinite().all(dim=-1)
    seen = truth.where(counted[..., None], torch.ones((), dtype=truth.dtype, device=truth.device))
    distance = torch.linalg.vector_norm(normalized(points, counted) - normalized(seen, counted), dim=-1)
    return _mean(confidence * distance - ALPHA * confidence.log(), counted)


def normalized(points: Tensor, counted: Tensor) -> Tensor:
    """Return points [B, V, H, W, 3] over their sample's mean distance to the origin of the `counted` [B, V, H, W]."""
    distance = torch.linalg.vector_norm(points, dim=-1).where(counted, 0.0)
    mean = distance.sum(dim=(1, 2, 3)) / counted.sum(dim=(1, 2, 3)).clamp(min=1)
    return points / mean.clamp(min=_SMALLEST)[:, None, None, None, None]


def _mean(values: Tensor, counted: Tensor) -> Tensor:
    return values.where(counted, 0.0).sum() / counted.sum().clamp(min=1)
