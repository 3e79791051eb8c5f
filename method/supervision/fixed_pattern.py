"""The supervision `fixed-pattern`: the pixel loss through a response of each camera, estimated from the clip itself.

A pixel of gain 1 + γ and dark level d shows (1 + γ) R + d of the light R. That pattern stays on the sensor while
surfaces cross it, and every view has another one, so what a fit of all views over all times leaves over, again and
again in the same pixel, is pattern. The loss is that of `pixel`, between (1 + γ) R + d, with R the rendered image, and
the measured image I. The maps are no parameters of the optimiser: they are the solution of least squares, anew
every few steps, for what was rendered so far.

For each pixel, r and i are the means of R and I over the steps that saw it, older steps with less weight. Then

    i - r = r (s + l) + m + e + noise,   γ = s + l,   d = m + e

    s: shading, smooth over the chip, told before the fit by points that views share (`self_calibration.shading`)
    l: the pixel's own gain                                  l ~ N(0, σ_l²)
    m: the typical dark level, a constant;  e: the pixel's own    e ~ N(0, σ_d²)
    noise: what the model still gets wrong there             N(0, σ_n²)

σ_n² is σ_0², and by how much the mean of u² (below) over a square around the pixel exceeds what patterns explain:
patterns are the same everywhere, but edges, and what moves before the fit has followed it, are not.

With v = σ_l² r² + σ_d² + σ_n² the most probable maps are

    l = σ_l² r u / v,   e = σ_d² u / v,   u = i - r - m - r s      of each pixel.

The mean of γ over a camera is 0, as the overall gain is the scene's.

Least squares of i on r over time could tell gain from dark where light changes, but moving edges that are rendered a
little late would lower all such gains; means over time do not see that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.method.settings import check_numbers
from spike4dgs.method.supervision.base import Render, Sample, Supervision, difference
from spike4dgs.method.supervision.pixel import PixelSettings


@dataclass(frozen=True)
class FixedPatternSettings(PixelSettings):
    """What is typical of a camera, and how fast its maps follow the fit (prefix `supervision`).

    The spreads are those of a real 250x400 spike camera, as published; `spikes.sensor_model` has the source of each.
    """

    pixel_gain: float = SENSOR.gain_local_spread  # σ_l
    dark: float = SENSOR.dark_median * math.exp(SENSOR.dark_log_spread**2 / 2)  # m: mean of the log-normal, spikes/tick
    # σ_d, that of the log-normal, in spikes per tick
    dark_spread: float = dark * math.sqrt(math.expm1(SENSOR.dark_log_spread**2))
    model_error: float = 0.002  # σ_0, in white
    noise_px: int = 7  # side of the square in which σ_n is measured
    memory: int = 20  # steps that see a pixel, over which the weight of one falls to 1/e
    every: int = 10  # steps between two solutions
    first: int = 20  # step of the first solution: soon, before Gaussians take up the pattern
    ssim_weight: float = 0.05  # SSIM is all contrast: with 0.2 Gaussians take up the pattern of flat surfaces

    def __post_init__(self) -> None:
        wanted = {
            "noise_px odd, of 1 or more": (self.noise_px, self.noise_px > 0 and self.noise_px % 2 == 1),
            "memory of 1 step or more": (self.memory, self.memory >= 1),
            "every of 1 step or more": (self.every, self.every >= 1),
        }
        check_numbers("supervision", wanted)


class FixedPattern(Supervision):
    """The loss of the module's text, for the training views of one scene."""

    label = "the cameras' fixed patterns estimated from the clip"
    defaults = FixedPatternSettings()
    shaded = True
    white: Tensor  # float64 [C, 1, 1], spikes per tick of white
    shading: Tensor  # s [C, H, W]
    gain: Tensor  # γ [C, H, W]
    dark: Tensor  # d [C, H, W], in white
    sums: Tensor  # [3, C, H, W], weighted: of steps, of R and of I

    def __init__(self, settings: FixedPatternSettings, scene: TrainingScene) -> None:
        super().__init__()
        self.settings = settings
        camera, states = scene.cameras[0], [scene.state(c.id) for c in scene.cameras]
        size = len(scene.cameras), camera.height, camera.width
        told = [state.shading for state in states]
        flat = np.ones(size[1:], np.float32)
        shading = np.stack([flat if found is None else found for found in told]) - 1
        white = torch.tensor([scene.radiance_gain * state.gain for state in states], dtype=torch.float64)[:, None, None]
        self.register_buffer("white", white, persistent=False)
        self.register_buffer("shading", torch.from_numpy(shading), persistent=False)  # a scene tells it again
        self.register_buffer("gain", self.shading.clone())
        self.register_buffer("dark", (settings.dark / white).float().repeat(1, *size[1:]))
        self.register_buffer("sums", torch.zeros(3, *size))

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """Return the loss of one rendered sample; remember it, and solve for the maps where it is time."""
        rendered, chosen = render(sample.t), list(sample.views)
        self._remember(rendered.detach(), sample)
        s = self.settings
        if sample.step >= s.first and sample.step % s.every == 0:
            self.gain, self.dark = solve(self.sums, self.shading, s, self.white)
        response = rendered * (1 + self.gain[chosen]) + self.dark[chosen]
        return difference(response, sample.images, s.ssim_weight, s.huber_delta)

    def estimates(self) -> dict[str, Tensor]:
        """Return the maps [C, H, W]: `gain` with mean 1 over each camera, `dark` in spikes per tick."""
        return {"gain": 1 + self.gain, "dark": self.dark * self.white.to(self.dark)}

    def _remember(self, rendered: Tensor, sample: Sample) -> None:
        chosen, seen = list(sample.views), sample.images.isfinite()
        new = torch.stack([torch.ones_like(rendered), rendered, sample.images])
        kept = torch.where(seen, math.exp(-1 / self.settings.memory), 1.0)  # what is not measured forgets nothing
        self.sums[:, chosen] = self.sums[:, chosen] * kept + torch.where(seen, new, 0.0)


def solve(sums: Tensor, shading: Tensor, s: FixedPatternSettings, white: Tensor) -> tuple[Tensor, Tensor]:
    """Return the most probable gain γ and dark level d, [C, H, W] each, from sums [3, C, H, W]; see the module.

    `shading` is s [C, H, W], `white` float64 [C, 1, 1] spikes per tick of white: dark levels are a sensor's own.
    """
    count, light, measured = sums
    seen = count > 0
    r, i = (torch.where(seen, total / count.clamp(min=1e-6), 0.0) for total in (light, measured))
    typical, own_dark = (s.dark / white).to(r), ((s.dark_spread / white) ** 2).to(r)
    own_gain = s.pixel_gain**2 * r * r
    own = torch.where(seen, i - r - typical - r * shading, 0.0)
    excess = (own.square() - own_gain - own_dark) * seen
    around = [avg_pool2d(x.to(r), s.noise_px, 1, s.noise_px // 2) for x in (excess, seen)]
    noise = s.model_error**2 + (around[0] / around[1].clamp(min=1e-6)).clamp(min=0)
    variance = own_gain + own_dark + noise
    gain = shading + s.pixel_gain**2 * r * own / variance
    return gain - gain.mean((1, 2), keepdim=True), typical + own_dark * own / variance
