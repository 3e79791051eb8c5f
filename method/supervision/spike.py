"""The supervision `spike`: SpikeNeRF's spike loss, on images rendered from Gaussians.

Public: Spike4DGS's Table 4 compares "pixel loss in vanilla 4DGS, spike loss in SpikeNeRF, and the combination
of the above" with its own, and does not write the spike loss down. SpikeNeRF's code does: the rendered intensity passes
a sensor model with per-pixel maps and an integrate-and-fire neuron of 256 steps; the mean of its spikes is compared
with the recorded mean spikes around the instant, by the mean of the squared difference after the exponent 1/2.2.

Our reading: the neuron and loss of Dy-SpikeNeRF (subtractive reset, random charge at the start); the sensor model is
`SpikeCameras`; the recorded window has `spike_ticks` ticks, as many as TFP's. The combination is the plain sum with the
supervision `pixel`.

The neuron gathers a constant current I for M steps and fires at the threshold theta = 1:

    V_t = V'_{t-1} + I,   S_t = 1 if V_t >= theta,   V'_t = 0 (hard) or V_t - theta S_t (subtract) after a spike.

Its output is the mean of S. The published surrogate of the gradient is dS/dV = 1/theta where the neuron fired; back
through time a spike forgets what came before it, so d mean(S) / dI = t_last / (M theta), and 0 where it never fired.
Both are in closed form here, O(1) for any M, because I is constant.

- A hard reset loses the charge above the threshold: only rates 1/n exist, up to half of I off. The camera subtracts.
- With a uniformly random charge at the start, which is how a camera is found at any instant, the subtractive neuron's
  mean over starts is I / theta exactly, and the surrogate's equals its derivative but for a share 1 / (I M) at most.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.settings import Settings, check_numbers
from spike4dgs.method.supervision.base import Render, Sample, Supervision
from spike4dgs.method.supervision.spike_cameras import SpikeCameras, random_charge, recorded
from spike4dgs.method.training_views.training_images import known

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


@dataclass(frozen=True)
class SpikeSettings(Settings):
    """Windows of the supervision `spike` (prefix `supervision`)."""

    spike_ticks: int = 40  # ticks of a recorded window, as many as TFP's has
    neuron_ticks: int = 256  # for which a neuron sees a rendered image: SpikeNeRF's; closed form, so they cost nothing

    def __post_init__(self) -> None:
        wanted = {
            "spike_ticks of 1 or more": (self.spike_ticks, self.spike_ticks >= 1),
            "neuron_ticks of 1 or more": (self.neuron_ticks, self.neuron_ticks >= 1),
        }
        check_numbers("supervision", wanted)


class SpikeRate(Supervision):
    """Mean squared difference of simulated and recorded mean spikes per tick, after the published gamma."""

    label = "SpikeNeRF's loss"
    calibrated = True
    defaults = SpikeSettings()

    def __init__(self, settings: SpikeSettings, scene: TrainingScene) -> None:
        super().__init__()
        self.settings, self.scene, self.cameras = settings, scene, SpikeCameras(scene)

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """Return the loss of one rendered sample."""
        s = self.settings
        counts, ticks = recorded(self.scene, sample, s.spike_ticks)
        current = self.cameras.rate(render(sample.t), sample.views)
        rate = firing_rate(current, random_charge(current, sample.step), s.neuron_ticks)
        return spike_loss(rate, known(counts.to(rate) / ticks, rate))
