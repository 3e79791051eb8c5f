"""True correspondences of views, from depth and cameras: exact up to the pixel that tells whether a point is hidden."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_HIDDEN = 0.03  # relative difference of depth from which a nearer surface hides the point


@dataclass(frozen=True, eq=False)
class Correspondence:
    """K points of a first view in a second one."""

    uv: Tensor  # [K, 2] px, in the second view
    seen: Tensor  # [K] bool: inside that view, in front of it, and not hidden


def correspond(at: Tensor, depth: tuple[Tensor, Tensor], K: tuple[Tensor, Tensor], a_to_b: Tensor) -> Correspondence:
    """Return the pixel-centre points `at` [K, 2] of view a, seen by view b.

    Args:
        at: px, centres of pixels.
        depth: [H, W] of both views along their axes, at the centres of the pixels; inf where nothing is.
        K: [3, 3] of both.
        a_to_b: [4, 4] from a's frame to b's.
    """
    height, width = depth[1].shape
    column, row = (at - 0.5).round().long().unbind(dim=1)
    z = depth[0][row, column].to(a_to_b)
    rays = torch.cat([at, torch.ones_like(at[:, :1])], dim=1).to(a_to_b) @ torch.linalg.inv(K[0]).T
    known = z.isfinite()
    there = (rays * z.where(known, 1.0)[:, None]) @ a_to_b[:3, :3].T + a_to_b[:3, 3]
    ahead = there[:, 2] > 1e-9
    projected = there @ K[1].T
    uv = projected[:, :2] / projected[:, 2:].where(ahead[:, None], 1.0)
    inside = ahead & (uv >= 0).all(dim=1) & (uv < uv.new_tensor([width, height])).all(dim=1)
    u, v = uv.where(inside[:, None], 0.0).long().unbind(dim=1)
    # Any surface of the nine pixels around the point may be its own: at an edge a pixel's centre may see either side.
    surface = torch.stack(
        [depth[1][(v + j).clamp(0, height - 1), (u + i).clamp(0, width - 1)] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    ).to(there)
    close = ((surface - there[:, 2]).abs() < _HIDDEN * there[:, 2]).any(dim=0)
    return Correspondence(uv, known & inside & close)
