"""The losses of matching, on exact correspondences.

Coarse: the negative logarithm that a point's cell and the cell of its partner are each other's best, as in LoFTR.
Fine: the distance of the first estimate, and the likelihood of the refined one under a Laplace distribution of the
error that the network expects: |error| / b + log b, smallest where b is the mean error.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from spike4dgs.method.matching.network import COARSE, FINE, Features, Matcher, middle_of_cell, points_of_cells
from spike4dgs.method.matching.training.truth import correspond

MOST_POINTS = 2048  # matches of a step that are refined: more take longer and teach the same
_LEAST_LOG, _MOST_LOG = -3.0, 2.0  # of the expected error in px: 0.05 to 7


@dataclass(frozen=True, eq=False)
class Views:
    """Truth of N views: depth [N, H, W] inf where nothing is, K [N, 3, 3], w2c [N, 4, 4]."""

    depth: Tensor
    K: Tensor
    w2c: Tensor


@dataclass(frozen=True, eq=False)
class MatchLosses:
    """Losses of a step, and what they were measured on."""

    total: Tensor
    coarse: float  # mean negative logarithm
    found: float  # share of the points that see their partner and whose best partner is right
    fine_px: float  # median distance after refinement


def match_losses(
    network: Matcher, features: Features, views: Views, pairs: Tensor, jitter: float, generator: torch.Generator
) -> MatchLosses:
    """Return the losses over the ordered `pairs` [P, 2] of views.

    A share `jitter` of the matches is refined from a cell to the side of the true one.
    """
    rows, columns = features.coarse.shape[2:]
    points = points_of_cells(rows, columns)
    logs = network.log_probabilities(features.coarse[pairs[:, 0]], features.coarse[pairs[:, 1]])
    coarse, right, first, second, at, uv = [], [], [], [], [], []
    for k, (a, b) in enumerate(pairs.tolist()):
        a_to_b = views.w2c[b] @ torch.linalg.inv(views.w2c[a])
        true = correspond(points, (views.depth[a], views.depth[b]), (views.K[a], views.K[b]), a_to_b)
        cell = (true.uv / COARSE).floor().long()
        seen = true.seen & (cell[:, 0] < columns) & (cell[:, 1] < rows)
        cell_of = (cell[:, 1] * columns + cell[:, 0])[seen]
        coarse.append(-logs[k][seen, cell_of])
        right.append(logs[k][seen].argmax(dim=1) == cell_of)
        count = int(seen.sum())
        first.append(torch.full((count,), a))
        second.append(torch.full((count,), b))
        at.append(points[seen])
        uv.append(true.uv[seen])
    nll, of, to, begin, end = (torch.cat(x) for x in (coarse, first, second, at, uv))
    if not len(nll):
        nothing = features.coarse.sum() * 0
        return MatchLosses(nothing, 0.0, 0.0, 0.0)
    chosen = torch.randperm(len(nll), generator=generator)[:MOST_POINTS]
    of, to, begin, end = of[chosen], to[chosen], begin[chosen].float(), end[chosen].float()
    near = middle_of_cell(end) + COARSE * _steps(len(end), jitter, generator)
    refined = network.refined(features.fine, features.fine, begin, near, (of, to))
    reachable = ((end - near).abs() < FINE * network.config.reach).all(dim=1)
    log_error = refined.log_error.clamp(_LEAST_LOG, _MOST_LOG)
    error = (refined.uv - end).abs().sum(dim=1)
    fine = (refined.first - end).abs().sum(dim=1) * 0.5 + error / log_error.exp() + 2 * log_error
    total = nll.mean() + fine[reachable].mean()
    px = torch.linalg.vector_norm(refined.uv - end, dim=1)[reachable].median()
    return MatchLosses(total, nll.mean().item(), torch.cat(right).float().mean().item(), px.item())


def _steps(count: int, share: float, generator: torch.Generator) -> Tensor:
    """Return steps [K, 2] to a neighbouring cell for a share of the points, and none for the others."""
    steps = torch.randint(-1, 2, (count, 2), generator=generator).float()
    return steps * (torch.rand(count, 1, generator=generator) < share)
