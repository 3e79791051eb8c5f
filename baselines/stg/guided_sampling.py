"""STG's guided sampling: where the worst views stay bad, new Gaussians are laid along the rays of the bad pixels.

Of the two views with the lowest SSIM, pixels count as bad where the difference of image and render, each divided by
its mean, lies in the upper 40 %; patches of 16x16 pixels that are bad for more than 85 % are sampled, three of four
pixels each, two points a ray. A tenth of the image at its borders is left out. All as published, with these changes:

- Two points a ray lie at the near and the far end of what the view sees (the 5 % and 95 % quantiles of its rendered
  depth), moved by up to 5 %. There they lie at 0.7 and 7.5 times the largest depth of the view's first points.
- The worst views are taken whatever their SSIM is. There they must lie below 0.91, which images made of spikes,
  with their noise, do at any fit.
- A view is judged at five times of the clip. There a view is one time of one camera.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from spike4dgs.baselines.stg.spacetime_decoder import rays
from spike4dgs.method.gaussians.parameters import Gaussians, from_points
from spike4dgs.method.motion.base import Motion
from spike4dgs.method.splat import RenderOutput, Views, render
from spike4dgs.method.splat.ssim import ssim
from spike4dgs.method.training_views.training_images import TrainingImages, known

VIEWS, TIMES = 2, 5
PATCH, BAD_PIXELS, BAD_SHARE = 16, 0.6, 0.85
BORDER, JITTER = 0.1, 0.05
OPACITY = 0.1


@torch.no_grad()
def guide(
    motion: Motion, gaussians: Gaussians, images: TrainingImages, rng: torch.Generator
) -> list[tuple[Gaussians, float]]:
    """Return new Gaussians and the time in [0, 1] of the image that asked for them, for each of the two worst views."""
    indices = np.unique(np.linspace(0, len(images.ticks) - 1, TIMES).astype(int)).tolist()
    found: list[tuple[float, int, int]] = []  # SSIM, view, time
    for view in range(len(images.views)):
        scores = [(_score(motion, gaussians, images, view, i), view, i) for i in indices]
        found.append(min(scores))
    new = []
    for _, view, index in sorted(found)[:VIEWS]:
        t = images.ticks[index] / images.n_ticks
        out, image = _render(motion, gaussians, images, view, t)
        target, camera = known(images.images[index, view], image), _one(images.views, view)
        pixels = bad_pixels(image, target)
        if len(pixels) >= 2:  # four points at least
            points = along_rays(camera, pixels, out, rng)
            values = target.flatten()[pixels].repeat(2)
            new.append(
                (from_points(points.cpu().numpy(), values.cpu().numpy(), opacity=OPACITY, device=str(points.device)), t)
            )
    return new


def _one(views: Views, view: int) -> Views:
    return Views(views.w2c[[view]], views.K[[view]], views.width, views.height)


def _render(
    motion: Motion, gaussians: Gaussians, images: TrainingImages, view: int, t: float
) -> tuple[RenderOutput, Tensor]:
    """Return the render of one view at t, and its gray image [H, W]."""
    camera = _one(images.views, view)
    out = render(motion.splats(gaussians, t), camera, depth=True)
    return out, motion.image(out.image, camera)[0]


def _score(motion: Motion, gaussians: Gaussians, images: TrainingImages, view: int, index: int) -> float:
    _, image = _render(motion, gaussians, images, view, images.ticks[index] / images.n_ticks)
    return float(ssim(image[None], known(images.images[index, view], image)[None]))


def bad_pixels(rendered: Tensor, image: Tensor) -> Tensor:
    """Return indices into H * W of the pixels to sample, for a render and its training image [H, W]."""
    height, width = image.shape
    error = (rendered / rendered.mean() - image / image.mean()).abs()
    rows, columns = height // PATCH, width // PATCH
    error = error[: rows * PATCH, : columns * PATCH]
    worst = torch.quantile(error, BAD_PIXELS)
    patches = (error > worst).float().view(rows, PATCH, columns, PATCH).mean((1, 3)) > BAD_SHARE  # [rows, columns]
    chosen = patches.repeat_interleave(PATCH, 0).repeat_interleave(PATCH, 1)
    chosen[::2, ::2] = False
    inside = torch.zeros_like(chosen)
    top, left = round(BORDER * height), round(BORDER * width)
    inside[top : height - top, left : width - left] = True
    v, u = torch.nonzero(chosen & inside).unbind(-1)
    return v * width + u


def along_rays(camera: Views, pixels: Tensor, out: RenderOutput, rng: torch.Generator) -> Tensor:
    """Return two points [2 P, 3] float32 on the rays of one view's pixels [P], at the ends of the rendered depths."""
    assert out.depth is not None  # `_render` asks for it
    opaque = out.alpha[0] > 0.5
    depth = out.depth[0][opaque] / out.alpha[0][opaque] if opaque.any() else out.depth.new_ones(1)
    z = torch.quantile(depth, depth.new_tensor([0.05, 0.95])).double()[:, None]  # [2, 1]
    jitter = 1 + JITTER * (2 * torch.rand(2, len(pixels), generator=rng) - 1)
    origin, direction = rays(camera)
    forward = camera.w2c[0, 2, :3]
    towards = direction[0].T[pixels].to(forward)  # [P, 3]
    distance = z * jitter.to(z) / (towards @ forward)  # [2, P]
    return (origin + distance[..., None] * towards).reshape(-1, 3).float()
