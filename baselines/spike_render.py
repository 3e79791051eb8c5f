"""The supervision `spike-render` of Dy-SpikeGS: fire spikes from the rendered image, compare them with the recorded.

Dy-SpikeGS is SpikeGS (Yu et al. 2024, arXiv 2409.15176) with the deformation of 4DGS. What is public of SpikeGS is its
abstract: Gaussians whose images pass a "noise embedding" and "spiking neurons", trained with a "spike rendering loss
that generalises over illumination". Its equations and code are not. All of the following is our reading:

    rate(x) = gain (I(x, t) exp(a(x)) + b(x))              a, b: noise embedding of every camera, learnt, 0 at first
    V_k = V_{k-1} + rate - s_{k-1},  s_k = [V_k >= 1]      integrate and fire, subtractive reset, M ticks around t
    L = (1 - w) mean |S - R| + w (1 - SSIM(S, R)) + v / 2 mean (a^2 + b^2),   S = mean_k s_k / gain, R: recorded

Integrate-and-fire with subtractive reset is the camera's public model, and L1 with SSIM is 3DGS's loss. `gain` is the
scene's spikes per tick of white, which a user knows, so that illumination needs no term of its own; of a camera whose
own gain differs, so many times as many, and of a sensor with dead ticks, the spikes that are left. The image is taken
as constant for M ticks. v keeps the embedding from painting the image itself: every camera is fixed, so that a(x) alone
could explain what it sees.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.sensor_model import fired
from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.settings import Settings
from spike4dgs.method.supervision.base import Render, Sample, Supervision, difference
from spike4dgs.method.supervision.spike_cameras import fire, random_charge, recorded


@dataclass(frozen=True)
class SpikeRenderSettings(Settings):
    """Numbers of the supervision `spike-render` (prefix `supervision`)."""

    spike_ticks: int = 40  # ticks of a recorded window, as many as TFP's has
    ssim_weight: float = 0.2  # 3DGS's lambda
    lr_noise: float = 1e-3
    noise_weight: float = 30.0  # of the noise embedding's mean square; with 0.1 it takes the images' edges: 7 dB lost


class SpikeRender(Supervision):
    """The loss of the module's text, for the training views of one scene."""

    label = "SpikeGS's loss"
    defaults = SpikeRenderSettings()

    def __init__(self, settings: SpikeRenderSettings, scene: TrainingScene) -> None:
        super().__init__()
        self.settings, self.scene = settings, scene
        first = scene.streams[0]
        self.dead_ticks, self.gains = first.dead_ticks, [scene.state(c.id).gain for c in scene.cameras]
        self.noise = nn.Parameter(torch.zeros(len(scene.streams), 2, first.height, first.width))  # a and b

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """Return the loss of one rendered sample."""
        s, gain = self.settings, self.scene.radiance_gain
        counts, ticks = recorded(self.scene, sample, s.spike_ticks)
        noise = self.noise[list(sample.views)]
        light = render(sample.t) * noise[:, 0].exp() + noise[:, 1]
        gains = light.new_tensor([self.gains[view] for view in sample.views])[:, None, None]
        rate = fired(gain * light * gains, self.dead_ticks)
        unit = ticks * gain
        spikes = fire(rate, random_charge(rate, sample.step), ticks)
        loss = difference(spikes / unit, counts.to(rate) / unit, s.ssim_weight)
        return loss + s.noise_weight * noise.square().mean()

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """Return the noise embedding and its learning rate."""
        rate = self.settings.lr_noise
        return {"noise": ([self.noise], Decay(rate, rate))}
