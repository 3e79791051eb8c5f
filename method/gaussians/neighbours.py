"""The nearest neighbours of each point among the others."""

from __future__ import annotations

import torch
from torch import Tensor


def nearest(points: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Return (indices int64 [N, k], distances float64 [N, k], m) of the `k` < N points nearest each of `points` [N, 3].

    The nearest comes first. No point is its own neighbour; points that coincide are neighbours of each other.
    """
    from scipy.spatial import cKDTree

    at = points.detach().cpu().double().numpy()
    distance, index = (torch.as_tensor(found) for found in cKDTree(at).query(at, k=k + 1))
    # A point is not always its own first neighbour: coincident points come in any order.
    itself = index == torch.arange(len(at))[:, None]  # [N, k + 1]
    itself[:, -1] |= ~itself.any(dim=1)
    others = ~itself
    return index[others].view(-1, k).to(points.device), distance[others].view(-1, k).to(points.device)
