"""Spacetime Gaussians (STG, Li et al. 2024): every Gaussian has a time of its own, an opacity that fades around it, and
a path through it.

With d = t - mu, and without gradient through d in the last three lines, as published:

    opacity(t)  = sigmoid(o) exp(-(d / exp(s))^2)
    mean(t)     = x + m1 d + m2 d^2 + m3 d^3
    rotation(t) = q + d w, normalised
    time feature(t) = d f

Scales are constant. "Full" splats features that a small decoder turns into images (`spacetime_decoder`); "lite"
splats gray values.

What differs from the published code, and why:

- Times are shares of the clip as there, but the clip is 20 ms and the points are those of the recipe's initialisation,
  which have no times. There every frame of a video has its points, each with the time of its frame. Here points whose
  place changes in the images (`moving`) are laid down several times over the clip, with the gray value that the
  views see at each time and a short life; all others live throughout, as they would in a static scene.
- A Gaussian that densification adds gets a random time, as published, and stays on its parent's path: its polynomial
  is the same one around the new time. There the path is shifted with the time, which tears moving things apart.
- Steps are a tenth of the published ones, and the rates of times, spins and decoder ten times higher.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor, nn

from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.gaussians.parameters import Edit, Gaussians, concatenate
from spike4dgs.method.motion.base import Extent, Motion
from spike4dgs.method.motion.guided_sampling import guide
from spike4dgs.method.motion.spacetime_decoder import Decoder
from spike4dgs.method.observations.lookup import look_up, moving
from spike4dgs.method.observations.training_images import TrainingImages
from spike4dgs.method.settings import TrainSettings
from spike4dgs.method.splat import Splats, Views

CUBIC = 9  # m1, m2, m3
PIECE_TICKS = 400  # 20 ms at 20 kHz
PIECE_IMAGES = 20  # at least about as many times of a view in each


class SpacetimeLite(Motion):
    """The motion part `spacetime-lite`: gray values, no decoder."""

    rests_first = False

    def __init__(self, extent: Extent, settings: TrainSettings, generator: torch.Generator) -> None:
        super().__init__()
        self.extent, self.settings, self.generator = extent, settings, generator

    def splats(self, gaussians: Gaussians, t: float) -> Splats:
        """The Gaussians at t in [0, 1]; one that has faded below 1/255 is left out by every rasteriser."""
        return Splats(*at_time(gaussians, t), self.colors(gaussians, t))

    def colors(self, gaussians: Gaussians, t: float) -> Tensor:
        """What is splatted at t: gray [N, 1]."""
        return gaussians.colors

    def attach(self, gaussians: Gaussians, footage: TrainingImages) -> Gaussians:
        """Give every Gaussian a time, a life and a path at rest; lay the moving ones down at several times."""
        s = self.settings
        shift = moving(gaussians.means, footage) > s.moving_change
        n, copies = int(shift.sum()), s.moving_copies
        parts = [self.timed(gaussians.rows(~shift), torch.full((len(gaussians) - n,), 0.5), s.static_life)]
        for i in range(copies if n else 0):
            times = (i + torch.rand(n, generator=self.generator)) / copies
            part = gaussians.rows(shift)
            seen = look_up(part.means, times, footage)
            colors = torch.where(seen.isnan(), part.colors[:, 0], seen)[:, None]
            parts.append(self.timed(replace(part, colors=colors), times, s.moving_life))
        return concatenate(parts)

    def timed(self, gaussians: Gaussians, times: Tensor, life: float) -> Gaussians:
        """Gaussians at rest around their times [N]; they live for the share `life` of the clip."""
        means = gaussians.means
        extra = {
            "times": times.to(means),
            "lives": torch.full_like(means[:, 0], math.log(life)),
            "paths": means.new_zeros(len(means), CUBIC),
            "spins": torch.zeros_like(gaussians.quats),
        }
        return replace(gaussians, extra=extra)

    def guide(self, gaussians: Gaussians, footage: TrainingImages, generator: torch.Generator) -> Gaussians:
        """Gaussians for what the worst views lack (`guided`)."""
        life = self.settings.moving_life
        new = guide(self, gaussians, footage, generator)
        return concatenate([gaussians, *(self.timed(g, torch.full((len(g),), t), life) for g, t in new)])

    def born(self, edit: Edit, generator: torch.Generator) -> Edit:
        """Move what densification added to random times, along its paths."""
        g = edit.gaussians
        times = g.extra["times"].clone()
        times[len(g) - edit.added :] = torch.rand(edit.added, generator=generator)
        return replace(edit, gaussians=move_to(g, times))

    def rates(self) -> dict[str, Decay]:
        """Constant rates of times, lives, paths and spins."""
        s = self.settings
        path = 1.75 * s.means_rate * self.extent.scale  # 0.5 * 3.5 in the published code
        rates = {"times": s.times_rate, "lives": s.lives_rate, "paths": path, "spins": s.spins_rate}
        return {name: Decay(rate, rate) for name, rate in rates.items()}


class Paths(SpacetimeLite):
    """The motion part `paths`: gray values on polynomial paths that begin at rest in the middle of the clip.

    The static stage finds things where they are then; while the times open up, they are followed from there. One
    Gaussian sees its thing for the whole clip, which averages the noise that a short life would keep. Clips much longer
    than 20 ms are fitted in pieces: no cubic follows a wheel for longer, and what a Gaussian gets wrong at one time
    would pull at all others.
    """

    rests_first = True

    @property
    def pieces(self) -> int:
        """About 20 ms each, what a cubic can follow, or longer where images are too far apart for that.

        The cost of drawing does not grow with the clip.
        """
        s, ticks = self.settings, self.extent.n_ticks
        images = min(s.max_times, ticks / s.time_spacing_ticks)
        return 2 * round((min(ticks / PIECE_TICKS, images / PIECE_IMAGES) - 1) / 2) + 1

    def continued(self, gaussians: Gaussians, forward: bool) -> Gaussians:
        """The Gaussians as they are at the piece's end, or beginning, going on straight at the speed that they have."""
        end, ahead = (1.0, 0.5) if forward else (0.0, -0.5)
        with torch.no_grad():
            g = move_to(gaussians, torch.full_like(gaussians.logits, end))
            speed, spins = g.extra["paths"][:, :3], g.extra["spins"]
            logits = torch.logit(at_time(gaussians, end)[3], 1e-6)  # as far as they have faded
            there = replace(g, means=g.means + ahead * speed, quats=g.quats + ahead * spins, logits=logits)
            new = self.timed(there, torch.full_like(logits, 0.5), self.settings.static_life)
            new.extra["paths"][:, :3], new.extra["spins"][:] = speed, spins
        return new

    def attach(self, gaussians: Gaussians, footage: TrainingImages) -> Gaussians:
        """All at rest in the middle of the clip, for as long as it lasts."""
        return self.timed(gaussians, torch.full((len(gaussians),), 0.5), self.settings.static_life)

    def rates(self) -> dict[str, Decay]:
        """Paths must follow what moves while the times open up, and rest in the end."""
        s, scale = self.settings, self.extent.scale
        return {**super().rates(), "paths": Decay(s.paths_rate * scale, s.paths_rate_last * scale)}

    def guide(self, gaussians: Gaussians, footage: TrainingImages, generator: torch.Generator) -> Gaussians:
        """Nothing: what things lack is added to them, by densification, for as long as they are seen."""
        return gaussians

    def born(self, edit: Edit, generator: torch.Generator) -> Edit:
        """What densification added keeps its parent's time."""
        return edit


class Spacetime(SpacetimeLite):
    """The motion part `spacetime`: albedo, a view feature and a time feature, and the decoder."""

    def __init__(self, extent: Extent, settings: TrainSettings, generator: torch.Generator) -> None:
        super().__init__(extent, settings, generator)
        self.decoder = Decoder((extent.low + extent.high) / 2, extent.scale, generator)

    def colors(self, gaussians: Gaussians, t: float) -> Tensor:
        """Albedo, view feature and the time feature at t: [N, 3]."""
        view, time = gaussians.extra["features"].unbind(-1)
        d = t - gaussians.extra["times"].detach()
        return torch.stack([gaussians.colors[:, 0], view, d * time], -1)

    def image(self, image: Tensor, views: Views) -> Tensor:
        """The decoder's image."""
        decoded: Tensor = self.decoder(image, views)
        return decoded

    def timed(self, gaussians: Gaussians, times: Tensor, life: float) -> Gaussians:
        """As lite; view features start as the gray values and time features at 0, as published."""
        g = super().timed(gaussians, times, life)
        return replace(g, extra={**g.extra, "features": torch.cat([g.colors, torch.zeros_like(g.colors)], -1)})

    def rates(self) -> dict[str, Decay]:
        """The features' rate besides."""
        rate = self.settings.features_rate
        return {**super().rates(), "features": Decay(rate, rate)}

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """The decoder."""
        rate = self.settings.decoder_rate
        return {"decoder": (list(self.decoder.parameters()), Decay(rate, rate))}


def at_time(gaussians: Gaussians, t: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means, quaternions, scales and opacities at t, as `Splats` takes them."""
    extra = gaussians.extra
    d = t - extra["times"]  # [N]
    fade = torch.exp(-(d * torch.exp(-extra["lives"])).square())
    d = d.detach()[:, None]
    quats = gaussians.quats + d * extra["spins"]
    return (
        gaussians.means + path(extra["paths"], d),
        quats,
        gaussians.log_scales.exp(),
        gaussians.logits.sigmoid() * fade,
    )


def path(coefficients: Tensor, d: Tensor) -> Tensor:
    """m1 d + m2 d^2 + m3 d^3 for coefficients [N, 9] and d [N, 1] -> [N, 3]."""
    m1, m2, m3 = coefficients.view(-1, 3, 3).unbind(1)
    return d * (m1 + d * (m2 + d * m3))


def move_to(gaussians: Gaussians, times: Tensor) -> Gaussians:
    """The same paths and spins around other times [N]."""
    extra = gaussians.extra
    d = (times - extra["times"])[:, None]
    m1, m2, m3 = extra["paths"].view(-1, 3, 3).unbind(1)
    paths = torch.cat([m1 + d * (2 * m2 + 3 * d * m3), m2 + 3 * d * m3, m3], -1)
    means, quats = gaussians.means + path(extra["paths"], d), gaussians.quats + d * extra["spins"]
    return replace(gaussians, means=means, quats=quats, extra={**extra, "paths": paths, "times": times})
