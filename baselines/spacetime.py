"""Spacetime Gaussians (STG, Li et al. 2024): Gaussians on polynomial paths (`polynomial`), each with its own time.

"Full" splats an albedo, a view feature and the time feature d f, d = t - mu without gradient, which a small decoder
turns into images; "lite" splats gray values.

Differences from the published code, and why:

- Times are shares of the clip as there, but the clip is 20 ms and the points are those of the recipe's initialisation,
  which have no times. There every frame of a video has its points, each with the time of its frame. Here points whose
  surroundings change in the images (`variation_at`) are laid down several times over the clip, with the gray value
  that the views see at each time and a short temporal scale; all others last throughout, as in a static scene.
- A Gaussian that densification adds gets a random time, as published, and stays on its parent's path: its polynomial
  is the same one around the new time. There the path is shifted with the time, which tears moving things apart.
- Steps are a tenth of the published ones, and the learning rates of times, angular velocities and decoder ten times
  higher.
- Guided sampling lays two points a ray at the near and the far end of what the view sees (5 % and 95 % of its rendered
  depth), moved by up to 5 %; there at 0.7 and 7.5 times the largest depth of the view's first points. The worst views
  are taken whatever their SSIM is; there it must lie below 0.91, which noisy images do at any fit. A view is judged at
  five times of the clip; there a view is one time of one camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.gaussians.parameters import Edit, Gaussians, concatenate, from_points
from spike4dgs.method.motion.base import Extent, Motion
from spike4dgs.method.motion.polynomial import PolynomialMotion, PolynomialSettings, move_to
from spike4dgs.method.splat import RenderOutput, Views, render
from spike4dgs.method.splat.lens import lens_rays
from spike4dgs.method.splat.ssim import ssim
from spike4dgs.method.training_views.changes import POINTS
from spike4dgs.method.training_views.points import look_up, variation_at
from spike4dgs.method.training_views.training_images import TrainingImages, known

HIDDEN = 6
CHANNELS = 3  # albedo, view feature, time feature


class Decoder(nn.Module):
    """STG's "Sandwich": radiance = albedo + W2 relu(W1 [view feature, time feature, ray origin, ray direction]).

    No biases. Images are gray, so one channel of each kind is left: W1 is [6, 8] and W2 [1, 6]; published for RGB, [6,
    12] and [3, 6]. No activation follows, as in the preset for linear images: radiance may exceed 1. Ray origins count
    from `center` [3] in units of `scale` metres.
    """

    def __init__(self, center: Tensor, scale: float, generator: torch.Generator) -> None:
        super().__init__()
        self.scale = scale
        self.center: Tensor
        self.register_buffer("center", center.float().clone())
        first = torch.empty(HIDDEN, CHANNELS - 1 + 6)
        nn.init.kaiming_uniform_(first, a=5**0.5, generator=generator)  # what torch's convolutions start from
        self.first = nn.Parameter(first)
        # Zero: the first images are the albedo. The published layer starts at random.
        self.second = nn.Parameter(torch.zeros(1, HIDDEN))

    def forward(self, channels: Tensor, views: Views) -> Tensor:
        """Return gray radiance [V, H, W] of splatted channels [V, H, W, 3]."""
        planes = channels.permute(0, 3, 1, 2).flatten(2)  # [V, 3, H * W], which is how the CPU rasteriser keeps them
        rays = self._from_rays(views).to(planes.dtype)  # [V, 6, H * W]
        hidden = torch.baddbmm(rays, self.first[:, :2].expand(len(planes), -1, -1), planes[:, 1:]).relu()
        gray = planes[:, 0] + (self.second @ hidden)[:, 0]
        return gray.view(channels.shape[:3])

    def _from_rays(self, views: Views) -> Tensor:
        """Return the first layer's sums over ray origin and direction: [V, 6, H * W]."""
        origin, direction = rays(views)
        o = (origin.float() - self.center) / self.scale  # [V, 3]
        by_origin = o @ self.first[:, 2:5].T  # [V, 6]
        return self.first[:, 5:].expand(len(o), -1, -1) @ direction + by_origin[..., None]


def rays(views: Views) -> tuple[Tensor, Tensor]:
    """Return camera centres [V, 3] and float32 unit directions [V, 3, H * W] of the pixels' rays, in world coordinates.

    Directions are sums of a row's and a column's vector: a seventh of the time of a product with all pixels in float64.
    """
    R, t = views.w2c[:, :3, :3], views.w2c[:, :3, 3]
    center = -(R.mT @ t[..., None])[..., 0]
    if views.lenses is not None:
        return center, R.mT.float() @ lens_rays(views.K, views.lenses, views.width, views.height)
    back = (R.mT @ torch.linalg.inv(views.K.to(R)))[:, :, None, None]  # [V, 3, 1, 1, 3] pixel to ray
    down, across = (torch.arange(n, device=R.device) + 0.5 for n in (views.height, views.width))
    rows = back[..., 1] * down[:, None] + back[..., 2]  # [V, 3, H, 1]
    direction = rows.float() + (back[..., 0] * across).float()
    direction = direction * direction.square().sum(1, keepdim=True).rsqrt()
    return center, direction.flatten(2)


VIEWS, TIMES = 2, 5
PATCH, BAD_PIXELS, BAD_SHARE = 16, 0.6, 0.85
BORDER, JITTER = 0.1, 0.05
OPACITY = 0.1


@torch.no_grad()
def guide(
    motion: Motion, gaussians: Gaussians, images: TrainingImages, rng: torch.Generator
) -> list[tuple[Gaussians, float]]:
    """Return new Gaussians and the time in [0, 1] of the image that asked for them, for each of the two worst views.

    STG's guided sampling: in the views with the lowest SSIM, pixels count as bad where image and render, each divided
    by its mean, differ by more than in 60 % of the pixels; patches of 16x16 that are bad for more than 85 % are
    sampled, three of four pixels each, two points a ray, but for a tenth of the image at its borders.
    """
    indices = np.unique(np.linspace(0, len(images.ticks) - 1, TIMES).astype(int)).tolist()
    found: list[tuple[float, int, int]] = []  # SSIM, view, time
    for view in range(len(images.views)):
        scores = [(_score(motion, gaussians, images, view, i), view, i) for i in indices]
        found.append(min(scores))
    new = []
    for _, view, index in sorted(found)[:VIEWS]:
        t = images.ticks[index] / images.n_ticks
        out, image = _render(motion, gaussians, images, view, t)
        target, camera = known(images.measured(index, [view])[0], image), images.views.some([view])
        pixels = bad_pixels(image, target)
        if len(pixels) >= 2:  # four points at least
            points = along_rays(camera, pixels, out, rng)
            values = target.flatten()[pixels].repeat(2)
            new.append(
                (from_points(points.cpu().numpy(), values.cpu().numpy(), opacity=OPACITY, device=str(points.device)), t)
            )
    return new


def _render(
    motion: Motion, gaussians: Gaussians, images: TrainingImages, view: int, t: float
) -> tuple[RenderOutput, Tensor]:
    """Return the render of one view at t, and its gray image [H, W]."""
    camera = images.views.some([view])
    out = render(motion.splats(gaussians, t), camera, motion.pixel_filter, depth=True)
    return out, motion.image(out.image, camera)[0]


def _score(motion: Motion, gaussians: Gaussians, images: TrainingImages, view: int, index: int) -> float:
    _, image = _render(motion, gaussians, images, view, images.ticks[index] / images.n_ticks)
    return float(ssim(image[None], images.measured(index, [view])))


def bad_pixels(rendered: Tensor, image: Tensor) -> Tensor:
    """Return indices into H * W of the pixels to sample, for a render and its training image [H, W].

    There are none in views that are smaller than a patch.
    """
    height, width = image.shape
    rows, columns = height // PATCH, width // PATCH
    if rows * columns == 0:
        return torch.zeros(0, dtype=torch.long, device=image.device)
    error = (rendered / rendered.mean() - image / image.mean()).abs()
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


@dataclass(frozen=True)
class SpacetimeLiteSettings(PolynomialSettings):
    """Numbers of the motion `spacetime-lite` (prefix `motion`). Published rates in brackets, for 30,000 steps."""

    moving_temporal_scale: float = 0.3
    moving_change: float = POINTS.limit  # standard deviation over time, in white, above which points move
    moving_copies: int = 3  # times at which a moving point is laid down
    guided_rounds: int = 2  # of guided sampling, after the second and the following rounds of densification
    # Of the polynomials, x scene scale. The published code has 0.5 x 3.5 times the learning rate of the means.
    lr_coefficients: float = 1.75 * 1.6e-4


@dataclass(frozen=True)
class SpacetimeSettings(SpacetimeLiteSettings):
    """Numbers of the motion `spacetime`."""

    lr_features: float = 5e-3  # [2.5e-3 and 1e-3]
    lr_decoder: float = 1e-3  # [1e-4]


class SpacetimeLite(PolynomialMotion):
    """The motion `spacetime-lite`: gray values, no decoder."""

    defaults = SpacetimeLiteSettings()
    # STG sees 30,000 pairs of images and densifies 6 or 12 times, which is 7 times here.
    published = {"trainer.coarse_steps": 0, "trainer.fine_steps": 15000, "density.refine_every": 1250}
    rests_first = False
    settings: SpacetimeLiteSettings

    @property
    def guided_rounds(self) -> int:
        """The settings' number."""
        return self.settings.guided_rounds

    def initialize(self, gaussians: Gaussians, images: TrainingImages) -> Gaussians:
        """Return Gaussians with a time, a temporal scale and a path at rest; moving ones are there at several times."""
        s = self.settings
        shift = variation_at(gaussians.means, images) > s.moving_change
        n, copies = int(shift.sum()), s.moving_copies
        middle = torch.full((len(gaussians) - n,), 0.5)
        parts = [self.timed(gaussians.rows(~shift), middle, s.static_temporal_scale)]
        for i in range(copies if n else 0):
            times = (i + torch.rand(n, generator=self.generator)) / copies
            part = gaussians.rows(shift)
            seen = look_up(part.means, times, images)
            colors = torch.where(seen.isnan(), part.colors[:, 0], seen)[:, None]
            parts.append(self.timed(replace(part, colors=colors), times, s.moving_temporal_scale))
        return concatenate(parts)

    def guided_samples(self, gaussians: Gaussians, images: TrainingImages, generator: torch.Generator) -> Gaussians:
        """Return the Gaussians followed by new ones where the worst views lack some (`guide`)."""
        duration, lamp = self.settings.moving_temporal_scale, gaussians.colors.shape[1] - 1
        new = []
        for g, t in guide(self, gaussians, images, generator):
            dark = replace(g, colors=functional.pad(g.colors, (0, lamp)))  # in a lamp's light, where there is one
            new.append(self.timed(dark, torch.full((len(g),), t), duration))
        return concatenate([gaussians, *new])

    def after_densification(self, edit: Edit, generator: torch.Generator) -> Edit:
        """Return the edit with the added Gaussians moved to random times, along their paths."""
        g = edit.gaussians
        times = g.extra["times"].clone()
        times[len(g) - edit.added :] = torch.rand(edit.added, generator=generator)
        return replace(edit, gaussians=move_to(g, times))

    def learning_rates(self) -> dict[str, Decay]:
        """Return constant learning rates."""
        rate = self.settings.lr_coefficients * self.extent.scale
        return {**super().learning_rates(), "coefficients": Decay(rate, rate)}


class Spacetime(SpacetimeLite):
    """The motion `spacetime`: albedo, a view feature and a time feature, and the decoder."""

    label = "spacetime Gaussians"
    defaults = SpacetimeSettings()
    settings: SpacetimeSettings

    def __init__(self, extent: Extent, settings: SpacetimeSettings, generator: torch.Generator) -> None:
        super().__init__(extent, settings, generator)
        self.decoder = Decoder((extent.low + extent.high) / 2, extent.scale, generator)

    def colors(self, gaussians: Gaussians, t: float) -> Tensor:
        """Return albedo, view feature and the time feature at t: [N, 3]."""
        view, time = gaussians.extra["features"].unbind(-1)
        d = t - gaussians.extra["times"].detach()
        return torch.stack([gaussians.colors[:, 0], view, d * time], -1)

    def image(self, image: Tensor, views: Views) -> Tensor:
        """Return the decoder's image."""
        decoded: Tensor = self.decoder(image, views)
        return decoded

    def timed(self, gaussians: Gaussians, times: Tensor, temporal_scale: float) -> Gaussians:
        """Return Gaussians as lite does; view features start as gray values and time features at 0, as published."""
        g = super().timed(gaussians, times, temporal_scale)
        return replace(g, extra={**g.extra, "features": torch.cat([g.colors, torch.zeros_like(g.colors)], -1)})

    def learning_rates(self) -> dict[str, Decay]:
        """Return constant learning rates, the features' too."""
        rate = self.settings.lr_features
        return {**super().learning_rates(), "features": Decay(rate, rate)}

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """Return the decoder's layers and their learning rate."""
        rate = self.settings.lr_decoder
        return {"decoder": (list(self.decoder.parameters()), Decay(rate, rate))}


MOTIONS = {"spacetime": Spacetime, "spacetime-lite": SpacetimeLite}  # for the entry points `spike4dgs.motions`
