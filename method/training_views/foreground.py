"""The moving foreground of a clip: a mask for each view, the points in it, and the window that holds it.

A mask comes from the variation of each pixel over the clip (`changes`). Uniform surfaces change only at their outline,
so holes of a mask are filled. A mask holds every pixel that an object passes; the object's silhouette at one instant is
not known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes
from torch import Tensor

from spike4dgs.method.splat import Views
from spike4dgs.method.training_views.changes import MASKS, changing, without_specks
from spike4dgs.method.training_views.light_layers import in_mean_light
from spike4dgs.method.training_views.points import project, variation_at
from spike4dgs.method.training_views.training_images import TrainingImages

SMALLEST_PX = 20  # pixels of a part; noise makes smaller ones
CLOSE_PX = 7  # gaps up to this width between changing parts belong to the object
GROW_PX = 1  # the blurred outline, and Gaussians whose centre lies just outside
MOST_VIEWS = 0.5  # share of the views in which a moving point lies in the mask


def foreground_masks(images: Tensor) -> Tensor:
    """Return the pixels that something moving passes: bool [C, H, W] from images [T, C, H, W] of linear radiance."""
    changes = changing(images, MASKS).cpu().numpy()
    return torch.from_numpy(np.stack([_solid(view) for view in changes])).to(images.device)


def _solid(changes: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask [H, W] without specks, gaps and holes, its outline grown."""

    def disc(radius: int) -> NDArray[np.uint8]:
        return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2), np.uint8)

    opened = without_specks(changes)
    border = CLOSE_PX  # closing must not see the image's edge as something static
    padded = cv2.copyMakeBorder(opened, border, border, border, border, cv2.BORDER_REPLICATE)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc(CLOSE_PX // 2))[border:-border, border:-border]
    _, parts, stats, _ = cv2.connectedComponentsWithStats(closed)
    large = stats[:, cv2.CC_STAT_AREA] >= SMALLEST_PX
    large[0] = False  # what surrounds the parts
    return cv2.dilate(binary_fill_holes(large[parts]).astype(np.uint8), disc(GROW_PX)).astype(bool)


def foreground_points(points: Tensor, views: Views, masks: Tensor) -> Tensor:
    """Return which points [N, 3] m move, bool [N]: those in the masks [C, H, W] of most views that see them.

    A static point behind a moving object lies in its mask in some views only, if the array is wide enough.
    """
    hits, seen = _votes(points, views, masks)
    return (seen > 0) & (hits > MOST_VIEWS * seen)


def moving_points(points: Tensor, images: TrainingImages, limit: float) -> Tensor:
    """Return which points [N, 3] m move, bool [N]: those whose value varies by more than `limit` over the clip (white).

    And those in the foreground: light is constant inside of a uniform surface, though it moves.
    """
    images = in_mean_light(images)
    masks = foreground_masks(images.images)
    return (variation_at(points, images) > limit) | foreground_points(points, images.views, masks)


def stray_points(points: Tensor, views: Views, masks: Tensor) -> Tensor:
    """Return which points [N, 3] m left the foreground, bool [N]: in some images, but not in the masks of most of them.

    A point outside all images does not count.
    """
    hits, seen = _votes(points, views, masks)
    return (seen > 0) & (hits <= MOST_VIEWS * seen)


def _votes(points: Tensor, views: Views, masks: Tensor) -> tuple[Tensor, Tensor]:
    """Return in how many masks, and in how many images, each point is: ([N], [N])."""
    pixels, inside = project(points.detach(), views)
    hit = masks.flatten(1).gather(1, pixels) & inside
    return hit.sum(0), inside.sum(0)


@dataclass(frozen=True, eq=False)
class Window:
    """The part of each view in which something moves, of one size in all views, and the cameras of these parts."""

    corner: tuple[tuple[int, int], ...]  # (x, y) px of the upper left corner in each view
    views: Views

    def cut(self, images: Tensor) -> Tensor:
        """Return the parts [..., C, h, w] of images [..., C, H, W]."""
        w, h = self.views.width, self.views.height
        parts = [images[..., c, y : y + h, x : x + w] for c, (x, y) in enumerate(self.corner)]
        return torch.stack(parts, dim=-3)


def moving_window(views: Views, masks: Tensor, margin: int) -> Window:
    """Return the smallest window that holds every mask [C, H, W] and `margin` px around it.

    It is the whole image where all masks are empty.
    """
    boxes = []
    for mask in masks.cpu().numpy():
        rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
        boxes.append((columns[0], rows[0], columns[-1] + 1, rows[-1] + 1) if len(rows) else None)
    found = [b for b in boxes if b]
    if not found:
        return Window(((0, 0),) * len(views), views)
    width = min(views.width, int(max(x1 - x0 for x0, _, x1, _ in found)) + 2 * margin)
    height = min(views.height, int(max(y1 - y0 for _, y0, _, y1 in found)) + 2 * margin)

    def start(low: int, high: int, size: int, whole: int) -> int:
        return int(min(max((low + high - size) // 2, 0), whole - size))

    corner = tuple(
        (start(b[0], b[2], width, views.width), start(b[1], b[3], height, views.height)) if b else (0, 0) for b in boxes
    )
    K = views.K.clone()
    K[:, :2, 2] -= torch.tensor(corner, dtype=K.dtype, device=K.device)
    return Window(corner, replace(views, K=K, width=width, height=height))
