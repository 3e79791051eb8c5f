"""SpikeNeRF's spiking layer: a radiance becomes the mean of an integrate-and-fire neuron's spikes (Zhu et al. 2024).

A neuron gathers a constant current I for M steps and fires at the threshold theta = 1:

    V_t = V'_{t-1} + I,   S_t = 1 if V_t >= theta,   V'_t = 0 (hard) or V_t - theta S_t (subtract) after a spike.

The layer's output is the mean of S. The step has no gradient, so the publication passes the surrogate dS/dV = 1/theta
where the neuron fired. Back through time, a spike forgets what came before it under both resets (a hard reset's factor
1 - S is held constant; in the subtraction dV'/dV = 1 - theta dS/dV = 0). What reaches I is therefore the number of
steps up to the last spike: d mean(S) / dI = t_last / (M theta), and 0 where it never fired.

Both are in closed form here, O(1) for any M, because I is constant; `unrolled` in the tests is the loop.

Properties:

- The reset. A hard reset loses the charge above the threshold, so that only rates 1/n exist: 1/n < I < 1/(n-1) gives
  1/n. The error is up to half of I (just below 1) and 12 % on average for I in (0, 0.5], with a slope of 0 between the
  jumps, which the surrogate hides. The camera subtracts: its rate is I within 1/M, and so is `subtract`, the default.
- The start. With a uniformly random charge at the start, which is how a camera is found at any instant, the subtractive
  neuron's mean over starts is I / theta exactly. That mean is smooth, its derivative is 1/theta, and the surrogate's
  mean over starts equals it up to the steps after the last spike, a share of at most 1 / (I M).
- The published sensor model divides by per-pixel maps of dark current and gain from a calibration of one camera. A
  training scene has radiance and one gain (spikes per step of white), and the current is their product.
"""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

Reset = Literal["subtract", "hard"]
THRESHOLD = 1.0  # theta, in units of the charge that one spike stands for
GAMMA = 1 / 2.2  # the publication compares rates after this exponent
FLOOR = 1 / 256  # added to rates before it: one spike in 256 ticks; the slope of x^(1/2.2) at 0 is infinite


class _FiringRate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, current: Tensor, start: Tensor, steps: int, reset: Reset) -> Tensor:
        # float64: 256 steps of a float32 current round to the wrong side of a threshold now and then.
        i, v = current.detach().double().clamp(0, THRESHOLD), start.double()
        safe = i.clamp(min=1e-12)
        if reset == "subtract":
            count = torch.floor((v + steps * i) / THRESHOLD)
            last = torch.ceil((count * THRESHOLD - v) / safe)
        else:
            first = torch.ceil((THRESHOLD - v) / safe)
            interval = torch.ceil(THRESHOLD / safe)
            count = torch.floor((steps - first) / interval).clamp(min=-1) + 1
            last = first + (count - 1) * interval
        last = torch.where(count > 0, last.clamp(1, steps), 0.0)
        ctx.save_for_backward((last / (steps * THRESHOLD)).to(current.dtype))
        return (count / steps).to(current.dtype)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        return grads[0] * ctx.saved_tensors[0], None, None, None


def firing_rate(current: Tensor, start: Tensor, steps: int, reset: Reset = "subtract") -> Tensor:
    """Return the mean spikes per step of neurons that gather `current` (any shape, charge per step) for `steps` steps.

    `start` is the charge before the first step, in [0, 1), of the same shape. The gradient is the surrogate's. A neuron
    fires at most once a step: currents above the threshold give 1, and still pass the gradient on.
    """
    out: Tensor = _FiringRate.apply(current, start, steps, reset)
    return out


def encode(rate: Tensor) -> Tensor:
    """Return (rate + FLOOR)^(1/2.2), the scale on which the publication compares rates."""
    return (rate + FLOOR) ** GAMMA


def spike_loss(rate: Tensor, recorded: Tensor) -> Tensor:
    """Return the mean squared error of simulated and recorded mean spikes per step, after the published gamma."""
    return (encode(rate) - encode(recorded)).square().mean()
