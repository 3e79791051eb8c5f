"""Parts that the losses on spikes share: recorded spikes around a tick, the neuron, and each camera's response."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from spike4dgs.benchmark.scene.camera_state import local_window
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.sensor_model import fired
from spike4dgs.method.supervision.base import Sample
from spike4dgs.method.training_views.training_images import bad_pixels, missing_images


class SpikeCameras(nn.Module):
    """The charge that pixels of a scene's training cameras gather, in units of the firing threshold.

        charge in a tick = white(x, y) I + dark(x, y)       I: radiance, 1.0 = white

    white / radiance gain is the n(x, y) of Spike4DGS (eq. 15), "obtained by capturing a uniform light scene". Both maps
    are estimates from the scene's calibration recordings. Without recordings, and at pixels for which the estimate is
    no number, n = 1 and dark = 0. The dark charge is not in eq. 15; it is what the recordings in the dark show.
    """

    white: Tensor  # [C, H, W] spikes per tick of white
    dark: Tensor  # [C, H, W] spikes per tick in the dark

    def __init__(self, scene: TrainingScene) -> None:
        super().__init__()
        first = scene.streams[0]
        self.dead_ticks = first.dead_ticks
        white = np.full((len(scene.streams), first.height, first.width), scene.radiance_gain, np.float32)
        dark = np.zeros_like(white)
        white *= np.array([scene.state(c.id).gain for c in scene.cameras], np.float32)[:, None, None]
        for i, found in enumerate(scene.calibrations or ()):
            light = found.radiance_gain * found.gain
            known = np.isfinite(light) & np.isfinite(found.dark)
            white[i][known], dark[i][known] = light[known], found.dark[known]
        # Not in checkpoints: a scene gives the same maps again.
        self.register_buffer("white", torch.from_numpy(white), persistent=False)
        self.register_buffer("dark", torch.from_numpy(dark), persistent=False)

    def rate(self, image: Tensor, views: tuple[int, ...]) -> Tensor:
        """Return the spikes per tick [V, H, W] of the cameras `views` whose renders are the radiance `image`.

        They are the charge per tick, where no tick is dead.
        """
        chosen = list(views)
        found: Tensor = fired(image * self.white[chosen] + self.dark[chosen], self.dead_ticks)
        return found


def recorded(scene: TrainingScene, sample: Sample, ticks: int) -> tuple[Tensor, int]:
    """Return spikes [V, H, W] float32 that the sample's views recorded in `ticks` ticks around its tick, and the ticks.

    At the clip's ends the window is what is left of it: at least the tick itself. Each camera's is by its own clock,
    and is moved to the end of its clip where it would leave it. The spikes of bad pixels are NaN, and those of a camera
    that lacks most ticks around the sample's.
    """
    start = sample.tick - ticks // 2
    first, last = max(0, start), min(scene.n_ticks, start + ticks)
    chosen = list(sample.views)
    clocks = [scene.state(scene.cameras[v].id).clock for v in chosen]
    windows = [local_window(clock, first, last, scene.n_ticks) for clock in clocks]
    counts = np.stack([scene.streams[v].counts(*w) for v, w in zip(chosen, windows, strict=True)]).astype(np.float32)
    if bad := bad_pixels(scene):
        counts[np.stack(bad)[chosen]] = math.nan
    if (missing := missing_images(scene, [sample.tick])) is not None:
        counts[missing[0, chosen]] = math.nan
    return torch.from_numpy(counts), last - first


def random_charge(like: Tensor, step: int) -> Tensor:
    """Return charges in [0, 1) of neurons before their first tick, of the shape of `like`, a function of the step.

    A camera's charge at a window's start is anything from 0 to 1. Random anew for each step, it makes the expected loss
    least at the right rate; a fixed one would leave rates free within a spike per window. Fits of all seeds share
    them.
    """
    return torch.rand(like.shape, generator=torch.Generator().manual_seed(step)).to(like)


def fire(rate: Tensor, charge: Tensor, ticks: int) -> Tensor:
    """Return the spikes in `ticks` ticks of neurons that gather `rate` per tick from `charge` in [0, 1); threshold 1.

    A neuron that loses 1 with each spike fires floor(charge + ticks rate) times while the rate lies in [0, 1], never
    below, at every tick above. The gradient is straight through, ticks per unit of rate: exactly that of the count's
    mean over all charges where the rate lies in (0, 1); beyond, it still pulls the rate back.
    """
    spikes: Tensor = _Fire.apply(rate, charge, ticks)
    return spikes


class _Fire(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rate: Tensor, charge: Tensor, ticks: int) -> Tensor:
        ctx.ticks = ticks
        return torch.floor(charge + ticks * rate).clamp(0, ticks)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        return grads[0] * ctx.ticks, None, None
