"""Dense depth by a cost volume over all views: features of known poses, compared over planes of inverse depth.

Each cell of a reference view is taken to every inverse depth w and seen by every other view; its score there is the
mean cosine between its fine feature and theirs, from the matching network. The best plane, refined by a parabola, gives
the depth, and its score the confidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.method.matching.adjust import Array
from spike4dgs.method.matching.network import FINE


@dataclass(frozen=True, eq=False)
class CellDepths:
    """Depth of the fine cells of a view, at their middles."""

    inverse: Float32  # [h, w] along the optical axis, in the array's unit
    confidence: Float32  # [h, w] in 0..1; 0 where fewer than two views see the point


@torch.inference_mode()
def cell_scores(fine: Tensor, size: tuple[int, int], array: Array, view: int, planes: Float64) -> Float32:
    """Return the scores [D, h, w] of a view's cells on `planes` [D], rising; -inf where fewer than two views see them.

    `fine` [V, F, h, w] are features, in cells of FINE px, of images of `size` (H, W) px: cells beyond are padding.
    """
    others = [j for j in range(len(fine)) if j != view]
    _, channels, rows, columns = fine.shape
    v, u = torch.meshgrid(torch.arange(rows) + 0.5, torch.arange(columns) + 0.5, indexing="ij")
    pixels = torch.stack([u, v, torch.full_like(u, 1 / FINE)], dim=-1).reshape(-1, 3) * FINE
    rays = pixels.double() @ torch.from_numpy(np.linalg.inv(array.K[view])).T
    own = functional.normalize(fine[view].reshape(channels, -1), dim=0)
    scores = torch.full((len(planes), rows * columns), -torch.inf)
    for k, w in enumerate(planes.tolist()):
        total, seen = torch.zeros(rows * columns), torch.zeros(rows * columns)
        for j in others:
            turn = torch.from_numpy(array.R[j] @ array.R[view].T)
            shift = torch.from_numpy(array.R[j] @ (array.centers[view] - array.centers[j]))
            p = (rays @ turn.T + w * shift) @ torch.from_numpy(array.K[j]).T
            uv = p[:, :2] / p[:, 2:].clamp(min=1e-9)
            grid = (2 * uv / uv.new_tensor([columns * FINE, rows * FINE]) - 1).float()
            inside = (p[:, 2] > 1e-9) & (uv > 0).all(dim=1) & (uv < uv.new_tensor(size[::-1])).all(dim=1)
            there = functional.grid_sample(fine[j, None], grid[None, None], align_corners=False)[0, :, 0]
            # Of unit length: a mean of two cells is shorter than either, and would count for less.
            total += (own * functional.normalize(there, dim=0)).sum(dim=0) * inside
            seen += inside
        scores[k] = torch.where(seen >= min(2, len(others)), total / seen.clamp(min=1), -torch.inf)
    return np.asarray(scores.reshape(-1, rows, columns).numpy())


def best_depths(scores: Float32, planes: Float64) -> CellDepths:
    """Return the depths of the best planes by scores [D, h, w]."""
    known = np.isfinite(scores)
    seen = known.any(axis=0)
    lowest = np.where(known, scores, np.inf).min(axis=0)
    filled = np.where(known, scores, np.where(seen, lowest, 0))  # a plane that no view sees is as bad as the worst
    best = filled.argmax(axis=0)
    inner = best.clip(1, len(planes) - 2)
    left, middle, right = (np.take_along_axis(filled, (inner + s)[None], axis=0)[0] for s in (-1, 0, 1))
    curvature = left - 2 * middle + right
    shift = np.where(curvature < -1e-9, 0.5 * (left - right) / np.minimum(curvature, -1e-9), 0.0).clip(-0.5, 0.5)
    place = np.where(inner == best, inner + shift, best)
    confidence = np.where(seen, filled.max(axis=0).clip(0, 1), 0)
    inverse = planes[0] + place * (planes[1] - planes[0])
    return CellDepths(inverse.astype(np.float32), confidence.astype(np.float32))
