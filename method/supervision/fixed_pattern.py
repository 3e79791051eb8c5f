"""The supervision `fixed-pattern`: the pixel loss through a response of each camera, estimated from the clip itself.

A pixel of gain 1 + γ and dark level d shows (1 + γ) R + d of the light R. That pattern stays on the sensor while
surfaces cross it, and every view has another one, so what a fit of all views over all times leaves over, again and
again in the same pixel, is pattern. The loss is that of `pixel`, between (1 + γ) R + d, with R the rendered image, and
the measured image I. The maps are no parameters of the optimiser: they are the solution of least squares, anew
every few steps, for what was rendered so far.

For each pixel, r and i are the means of R and I over the steps that saw it, older steps with less weight. Then

    i - r = r (s + l) + m + e + noise,   γ = s + l,   d = m + e

    s: shading, a sum of smooth cosines B a over the chip    a ~ N(0, S)
    l: the pixel's own gain                                  l ~ N(0, σ_l²)
    m: the typical dark level, a constant;  e: the pixel's own    e ~ N(0, σ_d²)
    noise: what the model still gets wrong there             N(0, σ_n²)

σ_n² is σ_0², and by how much the mean of u² (below) over a square around the pixel exceeds what patterns explain:
patterns are the same everywhere, but edges, and what moves before the fit has followed it, are not. Two rounds.

With v = σ_l² r² + σ_d² + σ_n² the most probable maps are

    a = (Bᵀ W B + 1/S)⁻¹ Bᵀ w (i - r - m),   W = r²/v,  w = r/v    of each camera,
    l = σ_l² r u / v,   e = σ_d² u / v,   u = i - r - m - r s      of each pixel.

(The weighted ridge regression of all unknowns at once, with l and e eliminated.) The mean of γ over a camera is 0, as
the overall gain is the scene's; and so is the mean of a over the cameras. For a pattern that all cameras have in
common, at the pixels that see one point, is a texture of the scene as well; only parallax and motion could tell. Left
free it drifts, and the scene with it.

Least squares of i on r over time could tell gain from dark where light changes, but moving edges that are rendered a
little late would lower all such gains; means over time do not see that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.method.supervision.base import Render, Sample, Supervision, difference
from spike4dgs.method.supervision.pixel import PixelSettings

_ROUNDS = 2  # of shading, and the noise that it leaves


@dataclass(frozen=True)
class FixedPatternSettings(PixelSettings):
    """What is typical of a camera, and how fast its maps follow the fit (prefix `supervision`).

    The spreads are those of a real 250x400 spike camera, as published; `spikes.sensor_model` has the source of each.
    """

    shading: float = math.sqrt(SENSOR.gain_spread**2 - SENSOR.gain_local_spread**2)  # relative, standard deviation
    shading_order: int = 3  # half waves over the chip, of both directions together
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


class FixedPattern(Supervision):
    """The loss of the module's text, for the training views of one scene."""

    label = "the cameras' fixed patterns estimated from the clip"
    defaults = FixedPatternSettings()
    gain: Tensor  # γ [C, H, W]
    dark: Tensor  # d [C, H, W], in white
    sums: Tensor  # [3, C, H, W], weighted: of steps, of R and of I

    def __init__(self, settings: FixedPatternSettings, scene: TrainingScene) -> None:
        super().__init__()
        self.settings, self.white = settings, scene.radiance_gain
        camera = scene.cameras[0]
        size = len(scene.cameras), camera.height, camera.width
        self.register_buffer("gain", torch.zeros(size))
        self.register_buffer("dark", torch.full(size, settings.dark / self.white))
        self.register_buffer("sums", torch.zeros(3, *size))

    def forward(self, render: Render, sample: Sample) -> Tensor:
        """Return the loss of one rendered sample; remember it, and solve for the maps where it is time."""
        rendered, chosen = render(sample.t), list(sample.views)
        self._remember(rendered.detach(), sample)
        s = self.settings
        if sample.step >= s.first and sample.step % s.every == 0:
            self.gain, self.dark = solve(self.sums, s, self.white)
        response = rendered * (1 + self.gain[chosen]) + self.dark[chosen]
        return difference(response, sample.images, s.ssim_weight, s.huber_delta)

    def estimates(self) -> dict[str, Tensor]:
        """Return the maps [C, H, W]: `gain` with mean 1 over each camera, `dark` in spikes per tick."""
        return {"gain": 1 + self.gain, "dark": self.dark * self.white}

    def _remember(self, rendered: Tensor, sample: Sample) -> None:
        chosen, seen = list(sample.views), sample.images.isfinite()
        new = torch.stack([torch.ones_like(rendered), rendered, sample.images])
        kept = torch.where(seen, math.exp(-1 / self.settings.memory), 1.0)  # what is not measured forgets nothing
        self.sums[:, chosen] = self.sums[:, chosen] * kept + torch.where(seen, new, 0.0)


def solve(sums: Tensor, s: FixedPatternSettings, white: float) -> tuple[Tensor, Tensor]:
    """Return the most probable gain γ and dark level d, [C, H, W] each, from sums [3, C, H, W]; see the module.

    `white` is spikes per tick of white.
    """
    count, light, measured = sums
    seen = count > 0
    r, i = (torch.where(seen, total / count.clamp(min=1e-6), 0.0) for total in (light, measured))
    own_gain, own_dark = s.pixel_gain**2 * r * r, (s.dark_spread / white) ** 2
    left, noise = torch.where(seen, i - r - s.dark / white, 0.0), torch.full_like(r, s.model_error**2)
    basis, spread = shading_basis(r.shape[1], r.shape[2], s, r.device)
    for _ in range(_ROUNDS):
        variance = own_gain + own_dark + noise
        shading = _shading(r, left, variance, basis, spread)
        own = torch.where(seen, left - r * shading, 0.0)
        excess = (own.square() - own_gain - own_dark) * seen
        around = [avg_pool2d(x.to(r), s.noise_px, 1, s.noise_px // 2) for x in (excess, seen)]
        noise = s.model_error**2 + (around[0] / around[1].clamp(min=1e-6)).clamp(min=0)
    gain = shading + s.pixel_gain**2 * r * own / variance
    return gain - gain.mean((1, 2), keepdim=True), s.dark / white + own_dark * own / variance


def _shading(r: Tensor, left: Tensor, variance: Tensor, basis: Tensor, spread: Tensor) -> Tensor:
    """Return s [C, H, W], less what it is in the mean of the cameras."""
    weighted = basis * (r * r / variance).flatten(1)[:, None]  # [C, M, H * W]
    normal = weighted @ basis.T + torch.diag(spread**-2)
    a = torch.linalg.solve(normal, (r * left / variance).flatten(1) @ basis.T)  # [C, M]
    return ((a - a.mean(0)) @ basis).reshape(r.shape)


def shading_basis(height: int, width: int, s: FixedPatternSettings, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return the smooth cosines [M, H * W] and the standard deviation [M] of their coefficients.

    cos(i y) cos(j x), with 0 < i + j <= `shading_order`, x and y from 0 to pi over the chip. All are equally likely,
    and their sum varies by `shading`.
    """
    x, y = ((torch.arange(n, device=device) + 0.5) * (math.pi / n) for n in (width, height))
    orders = [(i, j) for i in range(s.shading_order + 1) for j in range(s.shading_order + 1 - i) if i + j]
    waves = [torch.outer((i * y).cos(), (j * x).cos()).flatten() for i, j in orders]
    basis = torch.stack(waves) if waves else x.new_zeros(0, height * width)
    total = basis.square().mean(1).sum().sqrt()
    return basis, torch.full((len(basis),), s.shading, device=device) / total
