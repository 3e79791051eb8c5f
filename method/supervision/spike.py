"""The supervision `spike`: SpikeNeRF's spike loss, on images rendered from Gaussians.

Public: Spike4DGS's Table 4 compares "pixel loss in vanilla 4DGS, spike loss in SpikeNeRF, and the combination
of the above" with its own, and does not write the spike loss down. SpikeNeRF's code does: the rendered intensity passes
a sensor model with per-pixel maps and an integrate-and-fire neuron of 256 steps; the mean of its spikes is compared
with the recorded mean spikes around the instant, by the mean of the squared difference after the exponent 1/2.2.

Our reading: the same neuron and loss as in Dy-SpikeNeRF (`radiance_field.spiking`: subtractive reset, random
charge at the start); the sensor model is `SpikeCameras`; the recorded window has `spike_ticks` ticks, as many as TFP's.
The combination is the plain sum with the supervision `pixel`.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.settings import Settings
from spike4dgs.method.supervision.base import Render, Sample, Supervision
from spike4dgs.method.supervision.spike_cameras import SpikeCameras, random_charge, recorded
from spike4dgs.method.supervision.spike_neuron import firing_rate, spike_loss
from spike4dgs.method.training_views.training_images import known


@dataclass(frozen=True)
class SpikeSettings(Settings):
    """Windows of the supervision `spike` (prefix `supervision`)."""

    spike_ticks: int = 40  # ticks of a recorded window, as many as TFP's has
    neuron_ticks: int = 256  # for which a neuron sees a rendered image: SpikeNeRF's; closed form, so they cost nothing


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
