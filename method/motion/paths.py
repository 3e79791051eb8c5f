"""The motion `paths`: gray values on polynomial paths that begin in the middle of the clip, at the speed seen there.

The static stage finds things where they are then; while the times open up, they are followed from there. One Gaussian
sees its thing for the whole clip, which averages the noise that a short temporal scale would keep. Clips much longer
than 20 ms are fitted in pieces: no cubic follows a wheel for longer, and an error at one time would pull at all others.

A Gaussian that densification adds keeps its parent's time, and nothing is laid down by guided sampling: what things
lack is added to them, for as long as they are seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.motion.polynomial import PolynomialMotion, PolynomialSettings, at_time, move_to
from spike4dgs.method.training_views.training_images import TrainingImages
from spike4dgs.method.training_views.velocities import velocities_at

FLOW = 0.05  # of a piece: the optical flow of first velocities looks as far to both sides


@dataclass(frozen=True)
class PathSettings(PolynomialSettings):
    """Numbers of the motion `paths` (prefix `motion`)."""

    lr_coefficients: float = 1.4e-3  # of the polynomials, in scene scales a clip
    lr_coefficients_last: float = 1.4e-4
    in_pace: bool = True  # images and pieces follow fast motion, see `method.pace`
    coherence: float = 0.01  # of neighbours' paths: white a pixel, for a departure of one pixel at the clip's ends


class Paths(PolynomialMotion):
    """Polynomial paths through the whole clip, in pieces where it is long."""

    label = "Gaussians on paths before a fixed background"
    defaults = PathSettings()
    settings: PathSettings

    @property
    def pieces(self) -> int:
        """One for each part of the clip, about, as a cubic can follow 20 ms: the next odd number, or the next above.

        The cost of rendering does not grow with the clip.
        """
        return 2 * (math.ceil if self.extent.pace > 1 else round)((self.extent.parts - 1) / 2) + 1

    @property
    def coherence(self) -> float:
        """See the base."""
        return self.settings.coherence

    def next_piece(self, gaussians: Gaussians, forward: bool) -> Gaussians:
        """Return the Gaussians as they are at the piece's end, or beginning, going straight on at their velocities."""
        end, ahead = (1.0, 0.5) if forward else (0.0, -0.5)
        with torch.no_grad():
            g = move_to(gaussians, torch.full_like(gaussians.logits, end))
            velocities, turning = g.extra["coefficients"][:, :3], g.extra["angular_velocities"]
            logits = torch.logit(at_time(gaussians, end)[3], 1e-6)  # as far as they have faded
            there = replace(g, means=g.means + ahead * velocities, quats=g.quats + ahead * turning, logits=logits)
            new = self.timed(there, torch.full_like(logits, 0.5), self.settings.static_temporal_scale)
            new.extra["coefficients"][:, :3], new.extra["angular_velocities"][:] = velocities, turning
        return new

    def initialize(self, gaussians: Gaussians, images: TrainingImages) -> Gaussians:
        """Return all Gaussians at rest in the middle of the clip, for as long as it lasts."""
        return self.timed(gaussians, torch.full((len(gaussians),), 0.5), self.settings.static_temporal_scale)

    def set_off(self, gaussians: Gaussians, images: TrainingImages) -> Gaussians:
        """Return them with the velocities of what the views see at them in the middle of the clip."""
        piece = images.n_ticks / self.pieces
        velocities = piece * velocities_at(gaussians.means, images, FLOW * piece)
        coefficients = torch.cat([velocities, gaussians.extra["coefficients"][:, 3:]], 1)
        return replace(gaussians, extra={**gaussians.extra, "coefficients": coefficients})

    def learning_rates(self) -> dict[str, Decay]:
        """Return the learning rates: coefficients must follow motion while the times open up, and rest in the end."""
        s, scale = self.settings, self.extent.scale
        coefficients = Decay(s.lr_coefficients * scale, s.lr_coefficients_last * scale)
        return {**super().learning_rates(), "coefficients": coefficients}
