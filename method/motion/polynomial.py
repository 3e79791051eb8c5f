"""Gaussians on polynomial paths, as in STG (Li et al. 2024): each has a time of its own and an opacity that fades.

With d = t - mu, and without gradient through d in the last two lines, as published:

    opacity(t)  = sigmoid(o) exp(-(d / exp(s))^2)       s: `log_temporal_scales`
    mean(t)     = x + m1 d + m2 d^2 + m3 d^3            m: `coefficients`
    rotation(t) = q + d w, normalised                   w: `angular_velocities`

Scales are constant. Times are shares of the clip, or of a piece of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.motion.base import Extent, Motion
from spike4dgs.method.motion.coherence import CUBIC
from spike4dgs.method.motion.polynomial_cpu import at_time_cpu
from spike4dgs.method.settings import Settings
from spike4dgs.method.splat import Splats


@dataclass(frozen=True)
class PolynomialSettings(Settings):
    """Numbers that all motions on polynomials share. Published rates in brackets, for 30,000 steps."""

    static_temporal_scale: float = 4.0  # of the clip: a Gaussian that fades by 1 % towards the clip's ends [1]
    lr_times: float = 1e-3  # [1e-4]
    lr_temporal_scales: float = 0.03  # [0.03]
    lr_angular_velocities: float = 1e-3  # [1e-4]


class PolynomialMotion(Motion):
    """Gray values on polynomial paths."""

    def __init__(self, extent: Extent, settings: PolynomialSettings, generator: torch.Generator) -> None:
        super().__init__()
        self.extent, self.settings, self.generator = extent, settings, generator

    def splats(self, gaussians: Gaussians, t: float) -> Splats:
        """Return the Gaussians at t in [0, 1]; one that has faded below 1/255 is left out by every rasteriser."""
        return Splats(*at_time(gaussians, t), self.colors(gaussians, t))

    def colors(self, gaussians: Gaussians, t: float) -> Tensor:
        """Return the channels that are splatted at t: gray [N, 1]."""
        return gaussians.colors

    def timed(self, gaussians: Gaussians, times: Tensor, temporal_scale: float) -> Gaussians:
        """Return Gaussians at rest around their times [N], with a temporal scale in shares of the clip."""
        means = gaussians.means
        extra = {
            "times": times.to(means),
            "log_temporal_scales": torch.full_like(means[:, 0], math.log(temporal_scale)),
            "coefficients": means.new_zeros(len(means), CUBIC),
            "angular_velocities": torch.zeros_like(gaussians.quats),
        }
        return replace(gaussians, extra=extra)

    def learning_rates(self) -> dict[str, Decay]:
        """Return the constant learning rates of times, temporal scales and angular velocities."""
        s = self.settings
        rates = {
            "times": s.lr_times,
            "log_temporal_scales": s.lr_temporal_scales,
            "angular_velocities": s.lr_angular_velocities,
        }
        return {name: Decay(rate, rate) for name, rate in rates.items()}


def at_time(gaussians: Gaussians, t: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return means, quaternions, scales and opacities at t, as `Splats` takes them."""
    g, extra = gaussians, gaussians.extra
    if g.means.device.type != "cpu" or g.means.dtype != torch.float32:
        return at_time_reference(g, t)
    own = ("times", "log_temporal_scales", "coefficients", "angular_velocities")
    return at_time_cpu((g.means, g.log_scales, g.quats, g.logits, *(extra[name] for name in own)), t)


def at_time_reference(gaussians: Gaussians, t: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the same by plain torch: the twin of the kernels, and what runs on other devices."""
    extra = gaussians.extra
    d = t - extra["times"]  # [N]
    fade = torch.exp(-(d * torch.exp(-extra["log_temporal_scales"])).square())
    d = d.detach()[:, None]
    quats = gaussians.quats + d * extra["angular_velocities"]
    return (
        gaussians.means + path(extra["coefficients"], d),
        quats,
        gaussians.log_scales.exp(),
        gaussians.logits.sigmoid() * fade,
    )


def path(coefficients: Tensor, d: Tensor) -> Tensor:
    """Return m1 d + m2 d^2 + m3 d^3 [N, 3] for coefficients [N, 9] and d [N, 1]."""
    m1, m2, m3 = coefficients.view(-1, 3, 3).unbind(1)
    return d * (m1 + d * (m2 + d * m3))


def move_to(gaussians: Gaussians, times: Tensor) -> Gaussians:
    """Return the same paths and rotations, expanded around other times [N]."""
    extra = gaussians.extra
    d = (times - extra["times"])[:, None]
    m1, m2, m3 = extra["coefficients"].view(-1, 3, 3).unbind(1)
    moved = torch.cat([m1 + d * (2 * m2 + 3 * d * m3), m2 + 3 * d * m3, m3], -1)
    means = gaussians.means + path(extra["coefficients"], d)
    quats = gaussians.quats + d * extra["angular_velocities"]
    return replace(gaussians, means=means, quats=quats, extra={**extra, "coefficients": moved, "times": times})
