"""Gaussians on polynomial paths, as in STG (Li et al. 2024): each has a time of its own and an opacity that fades.

With d = t - mu, and without gradient through d in the last two lines, as published:

    opacity(t)  = sigmoid(o) exp(-(d / exp(s))^2)       s: `log_temporal_scales`
    mean(t)     = x + m1 d + m2 d^2 + m3 d^3            m: `coefficients`
    rotation(t) = q + d w, normalised                   w: `angular_velocities`

Scales are constant. Times are shares of the clip, or of a piece of it. The kernels' twin is `at_time_reference`: its
fifteen small operations and their gradients cost more than a render of a view.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.motion.base import Extent, Motion
from spike4dgs.method.motion.coherence import CUBIC
from spike4dgs.method.settings import Settings, check_numbers
from spike4dgs.method.splat import Splats
from spike4dgs.method.splat.kernels.jit import kernel
from spike4dgs.method.splat.kernels.threads import ITEM, run_items
from spike4dgs.method.splat.kernels.vector_ir import fetch_add

_SIDES: dict[str, tuple[int, ...]] = {  # of what `timed` adds, after the first
    "times": (),
    "log_temporal_scales": (),
    "coefficients": (CUBIC,),
    "angular_velocities": (4,),
}


@dataclass(frozen=True)
class PolynomialSettings(Settings):
    """Numbers that all motions on polynomials share. Published rates in brackets, for 30,000 steps."""

    static_temporal_scale: float = 4.0  # of the clip: a Gaussian that fades by 1.6 % towards the clip's ends [1]
    lr_times: float = 1e-3  # [1e-4]
    lr_temporal_scales: float = 0.03  # [0.03]
    lr_angular_velocities: float = 1e-3  # [1e-4]

    def __post_init__(self) -> None:
        scale = self.static_temporal_scale
        check_numbers("motion", {"static_temporal_scale above 0": (scale, scale > 0)})


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
    """Return means, quaternions, scales and opacities at t, as `Splats` takes them.

    Raises KeyError or ValueError for Gaussians without these parameters, as a file may hold.
    """
    g, extra = gaussians, gaussians.extra
    for name, sides in _SIDES.items():
        if extra[name].shape != (len(g), *sides):
            raise ValueError(f"{name} of {len(g)} Gaussians is {tuple(extra[name].shape)}")
    if g.means.device.type != "cpu" or g.means.dtype != torch.float32:
        return at_time_reference(g, t)
    return at_time_cpu((g.means, g.log_scales, g.quats, g.logits, *(extra[name] for name in _SIDES)), t)


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


Four = tuple[Tensor, Tensor, Tensor, Tensor]


def at_time_cpu(tensors: tuple[Tensor, ...], t: float) -> Four:
    """Return means, quaternions, scales and opacities at t, differentiable.

    tensors, float32: means [N, 3], log_scales [N, 3], quats [N, 4], logits [N], times [N], log_temporal_scales [N],
    coefficients [N, 9], angular_velocities [N, 4].
    """
    out: Four = _AtTime.apply(t, *tensors)  # type: ignore[no-untyped-call]
    return out


def _arrays(tensors: Iterable[Tensor]) -> tuple[Any, ...]:
    return tuple(x.detach().contiguous().numpy() for x in tensors)


class _AtTime(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, t: float, *tensors: Tensor) -> Four:
        ctx.t, arrays = np.float32(t), _arrays(tensors)
        means, log_scales, quats, logits = arrays[:4]
        out = np.empty_like(means), np.empty_like(quats), np.empty_like(log_scales), np.empty_like(logits)
        run_items(_forward, (ctx.t, *arrays, *out), len(means))
        at_t = tuple(torch.from_numpy(x) for x in out)
        ctx.save_for_backward(*tensors, at_t[2])
        return at_t[0], at_t[1], at_t[2], at_t[3]

    @staticmethod
    def backward(ctx: Any, *outer: Tensor) -> tuple[Any, ...]:
        d_means, d_quats, d_scales, d_opacities = (x.contiguous() for x in outer)
        _, log_scales, _, logits, times, durations, coefficients, turning, scales = _arrays(ctx.saved_tensors)
        own = tuple(np.empty_like(x) for x in (log_scales, logits, times, durations, coefficients, turning))
        given = (x.numpy() for x in (d_means, d_quats, d_scales, d_opacities))
        arguments = (ctx.t, logits, times, durations, scales, *given, *own)
        run_items(_backward, arguments, len(times))
        d_log_scales, *rest = (torch.from_numpy(x) for x in own)
        return None, d_means, d_log_scales, d_quats, *rest


@kernel
def _forward(
    t: Any, means: Any, log_scales: Any, quats: Any, logits: Any, times: Any, durations: Any, coefficients: Any,
    turning: Any, out_means: Any, out_quats: Any, scales: Any, opacities: Any, counter: Any,
) -> None:  # fmt: skip
    """Fill the last four arrays before `counter`."""
    one = np.float32(1)
    while True:
        first = fetch_add(counter, 0, 1) * ITEM  # type: ignore[call-arg]
        if first >= len(times):
            break
        for i in range(first, min(first + ITEM, len(times))):
            d = t - times[i]
            u = d * math.exp(-durations[i])
            opacities[i] = math.exp(-u * u) / (one + math.exp(-logits[i]))
            for k in range(3):
                m1, m2, m3 = coefficients[i, k], coefficients[i, 3 + k], coefficients[i, 6 + k]
                out_means[i, k] = means[i, k] + d * (m1 + d * (m2 + d * m3))
                scales[i, k] = math.exp(log_scales[i, k])
            for k in range(4):
                out_quats[i, k] = quats[i, k] + d * turning[i, k]


@kernel
def _backward(
    t: Any, logits: Any, times: Any, durations: Any, scales: Any, d_means: Any, d_quats: Any, d_scales: Any,
    d_opacities: Any, d_log_scales: Any, d_logits: Any, d_times: Any, d_durations: Any, d_coefficients: Any,
    d_turning: Any, counter: Any,
) -> None:  # fmt: skip
    """Fill the last six arrays before `counter`. No gradient goes through d = t - times in paths and rotations."""
    one, two = np.float32(1), np.float32(2)
    while True:
        first = fetch_add(counter, 0, 1) * ITEM  # type: ignore[call-arg]
        if first >= len(times):
            break
        for i in range(first, min(first + ITEM, len(times))):
            d = t - times[i]
            shrink = math.exp(-durations[i])
            u = d * shrink
            opacity = one / (one + math.exp(-logits[i]))
            d_opacity = d_opacities[i] * math.exp(-u * u)
            d_logits[i] = d_opacity * opacity * (one - opacity)
            d_u = -two * u * d_opacity * opacity
            d_times[i], d_durations[i] = -d_u * shrink, -d_u * u
            for k in range(3):
                d_log_scales[i, k] = d_scales[i, k] * scales[i, k]
                d_coefficients[i, k] = d_means[i, k] * d
                d_coefficients[i, 3 + k] = d_means[i, k] * d * d
                d_coefficients[i, 6 + k] = d_means[i, k] * d * d * d
            for k in range(4):
                d_turning[i, k] = d_quats[i, k] * d
