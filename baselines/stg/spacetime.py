"""Spacetime Gaussians (STG, Li et al. 2024): Gaussians on polynomial paths (`polynomial`), each with its own time.

"Full" splats an albedo, a view feature and the time feature d f, d = t - mu without gradient, which a small decoder
turns into images (`spacetime_decoder`); "lite" splats gray values.

Differences from the published code, and why:

- Times are shares of the clip as there, but the clip is 20 ms and the points are those of the recipe's initialisation,
  which have no times. There every frame of a video has its points, each with the time of its frame. Here points whose
  surroundings change in the images (`variation_at`) are laid down several times over the clip, with the gray value
  that the views see at each time and a short temporal scale; all others last throughout, as in a static scene.
- A Gaussian that densification adds gets a random time, as published, and stays on its parent's path: its polynomial
  is the same one around the new time. There the path is shifted with the time, which tears moving things apart.
- Steps are a tenth of the published ones, and the learning rates of times, angular velocities and decoder ten times
  higher.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from spike4dgs.baselines.stg.guided_sampling import guide
from spike4dgs.baselines.stg.spacetime_decoder import Decoder
from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.gaussians.parameters import Edit, Gaussians, concatenate
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.motion.polynomial import PolynomialMotion, PolynomialSettings, move_to
from spike4dgs.method.splat import Views
from spike4dgs.method.training_views.changes import POINTS
from spike4dgs.method.training_views.points import look_up, variation_at
from spike4dgs.method.training_views.training_images import TrainingImages


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
        """Return the Gaussians followed by new ones where the worst views lack some (`guided_sampling`)."""
        duration = self.settings.moving_temporal_scale
        new = guide(self, gaussians, images, generator)
        return concatenate([gaussians, *(self.timed(g, torch.full((len(g),), t), duration) for g, t in new)])

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
