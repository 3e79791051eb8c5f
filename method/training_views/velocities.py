"""Velocities of points in the middle of a clip: optical flow in each view, triangulated.

A view's flow f at a point x tells f = J v of its velocity v, with J the Jacobian of the view's projection at x. Some
views do not see the point, or mistake its flow: v is the weighted least squares over all views, with the weights of
Geman and McClure (1985) for the distance between f and J v.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.method.splat import Views
from spike4dgs.method.splat.lens import bent, bent_slopes
from spike4dgs.method.splat.types import NEAR
from spike4dgs.method.training_views.light_layers import in_mean_light
from spike4dgs.method.training_views.training_images import TrainingImages

ROUNDS = 6  # of reweighting
NEAR_PX = 0.3  # a flow that is further from J v than this counts little
DIFFER_PX = 1.0  # flows to both sides differ by more than this where something is covered, and are left out
LEAST_VIEWS = 3  # that know the flow at a point
LEAST_SIDE_PX = 12  # of a view: the search compares patches of 8 pixels, and refuses images that hold hardly one
PRIOR = 1e-2  # of the views' own weight: cameras stand close together, and know least of motion in depth


def velocities_at(points: Tensor, images: TrainingImages, ticks: float) -> Tensor:
    """Return the velocities [N, 3] of points [N, 3] in m a tick, in the middle of the clip; 0 where they are not known.

    They are means over `ticks` to both sides, or as near to that as there are images: several pixels of motion blur
    what turns, too few drown in noise. Returns 0 for all where images do not reach that far, or are tiny.
    """
    trio = _three_images(images, ticks)
    if trio is None or min(images.views.width, images.views.height) < LEAST_SIDE_PX:
        return torch.zeros_like(points)
    before, middle, after = trio
    values = in_mean_light(images).images[list(trio)].cpu().numpy()
    span = (images.ticks[after] - images.ticks[before]) / 2
    flows = torch.from_numpy(np.stack([mean_flow(*values[:, c]) for c in range(values.shape[1])])).double()
    if images.missing is not None:
        flows[images.missing[list(trio)].any(0).cpu()] = torch.nan
    views = images.views.to(torch.device("cpu"))
    return (_triangulated(points.detach().cpu().double(), views, flows) / span).to(points)


def _three_images(images: TrainingImages, ticks: float) -> tuple[int, int, int] | None:
    """Return the indices of the images in the middle of the clip, and `ticks` before and after.

    Where a gap holds one of them, they are those around the nearest other time.
    """
    at = np.array(images.ticks)
    nearest = np.abs(at - images.n_ticks / 2).argsort(kind="stable")
    for middle in map(int, nearest if images.missing is not None else nearest[:1]):
        before, after = (int(np.abs(at - at[middle] - sign * ticks).argmin()) for sign in (-1, 1))
        if before < middle < after and seen_by_enough(images, (before, middle, after)):
            return before, middle, after
    return None


def seen_by_enough(images: TrainingImages, times: Sequence[int]) -> bool:
    """Return whether `LEAST_VIEWS` views, or all where there are fewer, lack none of the images at some times."""
    if images.missing is None:
        return True
    whole = ~images.missing[list(times)].any(0)
    return int(whole.sum()) >= min(LEAST_VIEWS, len(whole))


def mean_flow(before: Float32, middle: Float32, after: Float32) -> Float32:
    """Return the mean flow [2, H, W] in px towards `after` and away from `before`; NaN where both differ."""
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(0)  # to the pixel
    flow: Callable[..., Any] = search.calc
    at, *others = ((255 * np.sqrt(image.clip(0, 1))).astype(np.uint8) for image in (middle, before, after))
    back, forth = (flow(at, other, None).transpose(2, 0, 1) for other in others)
    return np.asarray(np.where(np.hypot(*(forth + back)) < DIFFER_PX, (forth - back) / 2, np.nan), np.float32)


def _triangulated(points: Tensor, views: Views, flows: Tensor) -> Tensor:
    """Return the displacements [N, 3] m of points for the flows [C, 2, H, W] px of views, float64 on the CPU."""
    J, uv = _jacobians(points, views)
    size = uv.new_tensor([views.width, views.height])
    grid = (2 * uv / size - 1)[:, None]
    seen = grid_sample(flows, grid, padding_mode="border", align_corners=False)[:, :, 0].mT  # [C, N, 2]
    known = ((uv >= 0) & (uv < size) & seen.isfinite()).all(-1)
    seen = torch.where(known[..., None], seen, 0.0)
    J = torch.where(known[..., None, None], J, 0.0)
    weights, moved = known.double(), torch.zeros_like(points)
    for _ in range(ROUNDS):
        A = torch.einsum("cn,cnij,cnik->njk", weights, J, J)
        b = torch.einsum("cn,cnij,cni->nj", weights, J, seen)
        damp = PRIOR / 3 * A.diagonal(dim1=1, dim2=2).sum(-1) + 1e-12
        moved = torch.linalg.solve(A + damp[:, None, None] * torch.eye(3, dtype=A.dtype), b)
        away = (seen - torch.einsum("cnij,nj->cni", J, moved)).norm(dim=-1)
        weights = known / (1 + (away / NEAR_PX).square()).square()
    return torch.where((known.sum(0) >= LEAST_VIEWS)[:, None], moved, 0.0)


def _jacobians(points: Tensor, views: Views) -> tuple[Tensor, Tensor]:
    """Return how pixels move with points, [C, N, 2, 3] px / m, and where views see them, [C, N, 2] px; NaN: nowhere."""
    R, K = views.w2c[:, :3, :3].double(), views.K.double()
    p = points @ R.mT + views.w2c[:, None, :3, 3].double()  # [C, N, 3]
    x, y, z = p.where(p[..., 2:] > NEAR, torch.nan).unbind(-1)
    xy, nil = torch.stack([x / z, y / z], -1), torch.zeros_like(x)
    slopes = torch.stack([torch.stack([1 / z, nil, -x / z**2], -1), torch.stack([nil, 1 / z, -y / z**2], -1)], -2)
    if views.lenses is not None:
        lenses = views.lenses[:, None].double()
        slopes, (xy, shown) = bent_slopes(xy, lenses) @ slopes, bent(xy, lenses)
        xy = xy.where(shown[..., None], torch.nan)
    f = K[:, None, :2, :2].diagonal(dim1=2, dim2=3)  # [C, 1, 2] px
    return f[..., None] * slopes @ R[:, None], f * xy + K[:, None, :2, 2]
