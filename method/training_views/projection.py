"""Projection of points into views: the pixels that see them."""

from __future__ import annotations

import torch
from torch import Tensor

from spike4dgs.method.splat import Views


def project(points: Tensor, views: Views) -> tuple[Tensor, Tensor]:
    """Return the pixels that see points [N, 3]: index into H * W [C, N], and whether the point is in the image [C, N].

    The index of a point outside the image is 0. Computes in the wider dtype of points and views.
    """
    dtype = torch.promote_types(points.dtype, views.w2c.dtype)
    w2c, K = views.w2c.to(dtype), views.K.to(dtype)
    p = points.to(w2c) @ w2c[:, :3, :3].mT + w2c[:, None, :3, 3]  # [C, N, 3]
    in_front = p[..., 2] > 0
    uv = (p @ K.mT)[..., :2] / torch.where(in_front, p[..., 2], 1.0)[..., None]
    size = uv.new_tensor([views.width, views.height])
    inside = in_front & (uv >= 0).all(-1) & (uv < size).all(-1)
    u, v = torch.where(inside[..., None], uv, 0.0).long().unbind(-1)
    return v * views.width + u, inside
