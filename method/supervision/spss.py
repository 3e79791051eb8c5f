"""Spike variation supervision of Spike4DGS (section 3.4, eqs. 15-17), the spike half of the supervision `spss`.

    S(t) = IF(I(t) n(x, y))                                          eq. 15; n: `SpikeCameras`
    S(window) = phi_s(S(t)),   phi_s: (H, W, 1) -> (H, W, Gamma)     eq. 16, "a one-layer MLP"
    L = |avg S(window) - avg R(window)| + |std S(window) - std R(window)|     eq. 17, means over pixels; R: recorded

Public is the text of these equations. It leaves open, and is read here as follows:

- The neuron: subtractive reset, random charge at the start of each step (`spike_cameras.fire`).
- "A single spike", the value (H, W, 1) that the neuron gives for one rendered image, is its mean spikes over
  `neuron_ticks` ticks, as in SpikeNeRF. With 1 it would be binary, and no image minimises the L1 distance of a binary
  value to a mean: in expectation the straight-through gradient of |S - R| pulls every rate to 1/2. A fit of a car
  (64x40 pixels, a quarter of `quick`) came to 3.0 dB with 1 and to 30.6 dB with 256.
- phi_s: one linear layer and a sigmoid, since what comes out are spikes. It begins as the sequence that an even stream
  of spikes has, sorted: element k fires where the value exceeds (k + 1/2) / Gamma. Average and deviation are then those
  of Gamma binary spikes, but for the width of a sigmoid. It is trained with the Gaussians.
- std: that of the population, which is 0 and not undefined for a window of one tick. Its slope is infinite where the
  variance is 0, so FLOOR is added to both variances.
- Gamma = `spike_ticks`: not published; 40, a window of TFP. At the clip's ends R's window is shorter; averages and
  deviations are compared all the same.

Properties. Spikes are 0 or 1, so that std R = sqrt(a (1 - a)) with a = avg R, exactly: the second term of eq.
17 holds nothing that the first does not. It weights it, most where pixels are dark and nothing at a = 1/2.

phi_s sees one number per pixel, and that number has neuron_ticks + 1 values. It is evaluated once for each of them, not
for each pixel: 257 rows instead of 100,000 for 4 views of 200x125, with the same values and gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.supervision.base import Render, Sample, Supervision
from spike4dgs.method.supervision.spike import SpikeSettings
from spike4dgs.method.supervision.spike_cameras import SpikeCameras, fire, random_charge, recorded
from spike4dgs.method.training_views.training_images import known

FLOOR = 1e-6  # of variances: a deviation of 1/1000, where one spike in 40 ticks makes 0.16
# Of phi_s at first, per step between two thresholds. Sigmoids lower the window's variance by 1 / (STEEPNESS Gamma),
# which the second term takes for too much or too little light: with 3, at a rate of 0.3, for 0.02 spikes per tick.
STEEPNESS = 8.0


@dataclass(frozen=True)
class SpikeVariationSettings(SpikeSettings):
    """Windows as those of `spike`, and phi_s (prefix `supervision`)."""

    lr_phi: float = 1e-2


class SpikeVariation(Supervision):
    """The loss of the module's text, for the training views of one scene."""

    defaults = SpikeVariationSettings()

    def __init__(self, settings: SpikeVariationSettings, scene: TrainingScene) -> None:
        super().__init__()
        self.settings, self.scene, self.cameras = settings, scene, SpikeCameras(scene)
        self.phi = nn.Linear(1, settings.spike_ticks)
        first_sequence(self.phi)

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """Return the loss of one rendered sample."""
        s = self.settings
        counts, ticks = recorded(self.scene, sample, s.spike_ticks)
        rate = self.cameras.rate(render(sample.t), sample.views)
        spike = fire(rate, random_charge(rate, sample.step), s.neuron_ticks) / s.neuron_ticks  # [V, H, W]
        average, deviation = window_moments(self.phi, spike, s.neuron_ticks)
        seen = counts.to(rate) / ticks
        spread = (seen * (1 - seen) + FLOOR).sqrt()  # of spikes that are 0 or 1
        return (average - known(seen, average)).abs().mean() + (deviation - known(spread, deviation)).abs().mean()

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """Return phi_s and its learning rate."""
        return {"phi": (list(self.phi.parameters()), Decay(self.settings.lr_phi, self.settings.lr_phi))}


@torch.no_grad()
def first_sequence(phi: nn.Linear) -> None:
    """Set phi_s to the sorted sequence of an even stream: element k switches at the value (k + 1/2) / Gamma."""
    ticks = phi.out_features
    phi.weight.fill_(STEEPNESS * ticks)
    phi.bias.copy_(-STEEPNESS * (torch.arange(ticks) + 0.5))


def window_moments(phi: nn.Linear, spike: Tensor, levels: int) -> tuple[Tensor, Tensor]:
    """Return average and standard deviation over the window sigmoid(phi(spike)) of every pixel.

    `spike` holds multiples of 1 / levels in [0, 1]. Values and gradients, in `spike` and in phi's parameters, are those
    of phi applied to each pixel: they are taken from a table of levels + 1 rows.
    """
    nodes = torch.arange(levels + 1, dtype=spike.dtype, device=spike.device)[:, None] / levels
    sequence = phi(nodes).sigmoid()  # [levels + 1, Gamma]
    average = sequence.mean(-1)
    centred = sequence - average[:, None]
    deviation = (centred.square().mean(-1) + FLOOR).sqrt()
    with torch.no_grad():
        rise = sequence * (1 - sequence) * phi.weight[:, 0]
        slopes = rise.mean(-1), (centred * rise).mean(-1) / deviation
    row = (spike.detach() * levels).round().long().flatten()
    step = spike - spike.detach()  # 0, with the gradient of `spike`
    average, deviation = (
        _rows(value, row).view_as(spike) + slope[row].view_as(spike) * step
        for value, slope in zip((average, deviation), slopes, strict=True)
    )
    return average, deviation


def _rows(table: Tensor, row: Tensor) -> Tensor:
    """Return rows of a table, differentiable in it: a device sorts their gradients and adds them up in one order."""
    return table.index_select(0, row) if table.device.type == "cpu" else table[row]
