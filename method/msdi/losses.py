"""What MSDI is trained with: L1 on images, and DUSt3R's confidence-weighted regression of points."""

from __future__ import annotations

from torch import Tensor

ALPHA = 0.2  # weight of the confidence's logarithm, DUSt3R's


def image_loss(images: Tensor, truth: Tensor, valid: Tensor | None = None) -> Tensor:
    """Mean |image - truth| over the pixels that count."""
    raise NotImplementedError


def point_loss(points: Tensor, confidence: Tensor, truth: Tensor, valid: Tensor) -> Tensor:
    """mean(C |X / z - Xgt / zgt| - alpha log C) of `points` and `truth` [B, V, H, W, 3] in view 0's frame.

    `confidence` and `valid` (bool) are [B, V, H, W].
    """
    raise NotImplementedError
