"""Adaptive density control: where Gaussians are added and which are removed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.gaussians.parameters import Edit, Gaussians, densify, prune, relocate
from spike4dgs.method.settings import Settings
from spike4dgs.method.splat import RenderOutput


@dataclass(frozen=True)
class DensitySettings(Settings):
    """When, where and how far Gaussians become denser (prefix `density`). Names are gsplat's where it has them."""

    refine_every: int = 100  # steps
    refine_stop: float = 0.6  # share of a stage
    grow_grad2d: float = 2e-4  # mean screen-space gradient (half-image units) above which a Gaussian is densified
    grow_scale3d: float = 0.01  # x scene scale: larger ones are split, smaller ones cloned
    prune_opacity: float = 0.005  # fainter ones are removed
    max_per_pixel: float = 0.8  # Gaussians per pixel of one view; 0.5 costs 0.6 dB and saves a fifth of the time
    max_moving_per_pixel: float = 0.4  # the same of those before a background, which is not counted
    max_gaussians: int = 1_000_000  # whatever the images' size; half as many before a background

    def __post_init__(self) -> None:
        if self.refine_every < 1:
            fix = "refine_stop=0 never changes the density"
            raise problem("settings of density", "refine_every of 1 step or more", str(self.refine_every), fix)
        if not self.grow_scale3d > 0:
            fix = "a small number splits all"
            raise problem("settings of density", "grow_scale3d above 0", str(self.grow_scale3d), fix)

    def due(self, done: int, steps: int) -> bool:
        """Return whether the density changes after `done` of a stage's `steps`."""
        return done % self.refine_every == 0 and self.ahead(done, steps)

    def ahead(self, done: int, steps: int) -> bool:
        """Return whether the density changes after `done` of a stage's `steps` or later in it."""
        return done <= self.refine_stop * steps

    def limit(self, width: int, height: int, background: bool) -> int:
        """Return the most Gaussians for views of a size, with a background behind them or not."""
        if background:
            return min(round(self.max_moving_per_pixel * width * height), self.max_gaussians // 2)
        return min(round(self.max_per_pixel * width * height), self.max_gaussians)


@dataclass(eq=False)
class GradientStatistics:
    """Screen-space gradients gathered since the last densification: where the image asks for more Gaussians."""

    gradient: Tensor  # [N] sum of |dLoss/dmeans2d| in half-image units, as if each view were a loss of its own
    seen: Tensor  # [N] number of views that saw the Gaussian

    @classmethod
    def zero(cls, n: int, device: torch.device) -> GradientStatistics:
        """Return statistics of `n` Gaussians with nothing gathered yet."""
        return cls(torch.zeros(n, device=device), torch.zeros(n, device=device))

    def add(self, out: RenderOutput, renders: int = 1) -> None:
        """Gather one rendered batch after its backward pass. Units as in 3DGS, whose thresholds are customary.

        A loss of the mean of so many `renders` gives each of them as small a part of the gradient of one.
        """
        grad = out.means2d.grad
        if grad is None:
            return
        views, height, width = out.alpha.shape
        visible = out.visible
        batch = views * renders
        length = torch.hypot(grad[..., 0] * (width / 2 * batch), grad[..., 1] * (height / 2 * batch))
        self.gradient += torch.where(visible, length, 0.0).sum(0).float()
        self.seen += visible.sum(0)

    def mean(self) -> Tensor:
        """Return the mean gradient [N] over the views that saw each Gaussian."""
        return self.gradient / self.seen.clamp(min=1)


def adapt_density(
    gaussians: Gaussians,
    statistics: GradientStatistics,
    settings: DensitySettings,
    scale: float,
    limit: int,
    rng: torch.Generator,
) -> list[Edit]:
    """Return the edits to apply: Gaussians are added where the gradient is high, as far as `limit` has room.

    Faint ones are deleted first. Where as many as `limit` or more are left without them, as of too many first points,
    they are moved to others instead, and none is added.
    """
    dead = gaussians.logits.detach().sigmoid() < settings.prune_opacity
    grow = statistics.mean() * ~dead
    room = limit - (len(gaussians) - int(dead.sum()))
    if room <= 0:
        return [relocate(gaussians, dead, rng)]
    want = grow > settings.grow_grad2d
    if int(want.sum()) > room:
        want = torch.zeros_like(dead).index_fill(0, torch.topk(grow, room).indices, True)
    large = gaussians.log_scales.detach().amax(-1) > math.log(settings.grow_scale3d * scale)
    first = densify(gaussians, want & ~large, want & large, rng)
    dead_then = first.gaussians.logits.sigmoid() < settings.prune_opacity
    second = prune(first.gaussians, ~dead_then)
    source = first.source[second.source]
    return [Edit(second.gaussians, source, int((source < 0).sum()))]
