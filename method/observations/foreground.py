"""What moves in a clip: a mask for each view from how much its images change, the moving points, and their window.

A fixed camera sees a static scene as one image with noise, so the standard deviation of a pixel over the clip tells
moving things from static ones without any learned segmentation. Uniform surfaces change only at their outline: holes
of a mask are filled. What it cannot tell is where a thing is at one instant: the mask holds all places it passes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes
from torch import Tensor

from spike4dgs.method.splat import Views

BLUR_PX = 3  # images are averaged over this width first: spike noise is white, things are not
NOISE_SHARE = 0.25  # at least this share of the pixels shows nothing but noise
NOISE_FACTOR = 4.0  # noise differs by a factor of two between dark and bright; motion exceeds it by ten
LOWEST, HIGHEST = 0.01, 0.05  # of white; bounds of the threshold where images are clean, or where everything moves
SMALLEST_PX = 20  # pixels of a part; noise makes smaller ones
CLOSE_PX = 7  # gaps up to this width between changing parts belong to the thing
GROW_PX = 1  # the blurred outline, and Gaussians whose centre lies just outside
MOST_VIEWS = 0.5  # share of the views in which a moving point lies in the mask


def temporal_deviation(pictures: Tensor) -> Tensor:
    """Standard deviation over time [C, H, W] of images [T, C, H, W], each averaged over 3x3 pixels."""
    total = torch.zeros(pictures.shape[1:], dtype=torch.float64, device=pictures.device)
    square = total.clone()
    for image in pictures:  # one time after another: a float64 copy of the clip would not fit
        smooth = torch.nn.functional.avg_pool2d(image[:, None].double(), BLUR_PX, 1, BLUR_PX // 2)[:, 0]
        total += smooth
        square += smooth * smooth
    n = len(pictures)
    return (square / n - (total / n) ** 2).clamp(min=0).sqrt()


def foreground_masks(pictures: Tensor) -> Tensor:
    """Where something moves in the clip: bool [C, H, W] from images [T, C, H, W] of linear radiance."""
    deviation = temporal_deviation(pictures).cpu().numpy()
    limit = float(np.clip(NOISE_FACTOR * np.quantile(deviation, NOISE_SHARE), LOWEST, HIGHEST))
    masks = np.stack([_solid(view > limit) for view in deviation])
    return torch.from_numpy(masks).to(pictures.device)


def _solid(changes: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Specks removed, gaps and holes filled, the outline grown; [H, W]."""

    def disc(radius: int) -> NDArray[np.uint8]:
        return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2), np.uint8)

    opened = cv2.medianBlur(changes.astype(np.uint8), 3)
    border = CLOSE_PX  # closing must not see the image's edge as something static
    padded = cv2.copyMakeBorder(opened, border, border, border, border, cv2.BORDER_REPLICATE)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc(CLOSE_PX // 2))[border:-border, border:-border]
    _, parts, stats, _ = cv2.connectedComponentsWithStats(closed)
    large = stats[:, cv2.CC_STAT_AREA] >= SMALLEST_PX
    large[0] = False  # what surrounds the parts
    return cv2.dilate(binary_fill_holes(large[parts]).astype(np.uint8), disc(GROW_PX)).astype(bool)


def foreground_points(points: Tensor, views: Views, masks: Tensor) -> Tensor:
    """Which points [N, 3] m lie in the masks [C, H, W] of most of the views that have them in the image: bool [N].

    Something static behind a moving thing lies in its mask from some places only, where the array is wide enough.
    """
    hits, seen = _votes(points, views, masks)
    return (seen > 0) & (hits > MOST_VIEWS * seen)


def stray_points(points: Tensor, views: Views, masks: Tensor) -> Tensor:
    """Which points [N, 3] m are in some images, but not in the masks of most of them: bool [N].

    Nothing moves there. What has left all images is not astray.
    """
    hits, seen = _votes(points, views, masks)
    return (seen > 0) & (hits <= MOST_VIEWS * seen)


def _votes(points: Tensor, views: Views, masks: Tensor) -> tuple[Tensor, Tensor]:
    """In how many masks, and in how many images, each point is: ([N], [N])."""
    inside, uv = _in_image(points, views)
    x, y = torch.where(inside[..., None], uv, 0.0).long().unbind(-1)  # [C, N]
    hit = masks[torch.arange(len(views), device=masks.device)[:, None], y, x] & inside
    return hit.sum(0), inside.sum(0)


def _in_image(points: Tensor, views: Views) -> tuple[Tensor, Tensor]:
    """(bool [C, N], px [C, N, 2]) of points [N, 3] in the views, in float64."""
    w2c, K = views.w2c.double(), views.K.double()
    eye = torch.einsum("cij,nj->cni", w2c[:, :3, :3], points.detach().double()) + w2c[:, None, :3, 3]
    screen = torch.einsum("cij,cnj->cni", K, eye)
    front = eye[..., 2] > 0
    uv = screen[..., :2] / torch.where(front, screen[..., 2], 1.0)[..., None]
    size = uv.new_tensor([views.width, views.height])
    return front & ((uv >= 0) & (uv < size)).all(-1), uv


@dataclass(frozen=True, eq=False)
class Window:
    """The part of each view in which something moves, of one size in all views, and the cameras that see just that."""

    corner: tuple[tuple[int, int], ...]  # (x, y) px of the upper left corner in each view
    views: Views

    def cut(self, images: Tensor) -> Tensor:
        """[..., C, H, W] -> [..., C, h, w]."""
        w, h = self.views.width, self.views.height
        parts = [images[..., c, y : y + h, x : x + w] for c, (x, y) in enumerate(self.corner)]
        return torch.stack(parts, dim=-3)


def moving_window(views: Views, masks: Tensor, margin: int) -> Window:
    """The smallest window that holds every mask [C, H, W] and `margin` px around it; all of a view without a mask."""
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
    return Window(corner, Views(views.w2c, K, width, height))
