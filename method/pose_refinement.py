"""Poses that are fitted: those of the training cameras with the scene, and a held-out view's to one of its images.

A model from estimated poses is a little off the calibrated frame in which held-out cameras are given, and a sharp image
rendered half a pixel aside scores badly. So two scores are published: at the calibrated pose, and after the pose alone
was fitted to pixels of the test view, with the Gaussians frozen (BARF, InstantSplat). Those pixels are of static things
only and of a time that is not scored (`benchmark.runs.refinement` chooses them).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.splat import Views
from spike4dgs.method.torch_state import one_torch_thread


@dataclass(frozen=True)
class Refinement:
    """Adam on the six numbers of a rigid motion: rotation in radians, translation in units of the scene's depth."""

    steps: int = 100  # BARF
    lr: float = 1e-3  # BARF on synthetic scenes; at a focal length of 225 px about 0.2 px a step
    lr_last: float = 1e-5  # cosine decay, so that noise is averaged at the end


REFINEMENT = Refinement()


def rigid_motion(xi: Tensor) -> Tensor:
    """Return the exponential [..., 4, 4] of xi [..., 6] (rotation vector, translation part); smooth at zero too."""
    x, y, z, a, b, c = xi.unbind(-1)
    zero = torch.zeros_like(x)
    rows = [zero, -z, y, a, z, zero, -x, b, -y, x, zero, c, zero, zero, zero, zero]
    motion: Tensor = torch.linalg.matrix_exp(torch.stack(rows, dim=-1).unflatten(-1, (4, 4)))
    return motion


class Poses(nn.Module):
    """Corrections of the poses of `views`, fitted together with the scene; `depth_m` is the scene's distance.

    A pose is exp(xi) w2c with xi = (rotation, translation / depth). The first camera keeps its pose: it holds the
    frame, in which the held-out cameras are given too. It cannot hold the scale, which starts right and which pixels do
    not pull at.
    """

    def __init__(self, views: Views, depth_m: float) -> None:
        super().__init__()
        self._start, self._depth_m = views, depth_m
        self.xi = nn.Parameter(torch.zeros(len(views) - 1, 6, dtype=views.w2c.dtype, device=views.w2c.device))

    def views(self, chosen: Sequence[int]) -> Views:
        """Return some of the views at their present poses, differentiable in `xi`."""
        start, index = self._start, list(chosen)
        units = torch.tensor([1.0] * 3 + [self._depth_m] * 3, dtype=self.xi.dtype, device=self.xi.device)
        moved = nn.functional.pad(self.xi * units, (0, 0, 1, 0))[index]
        some = start.some(index)
        return replace(some, w2c=rigid_motion(moved) @ some.w2c)

    @torch.no_grad()
    def cameras(self, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
        """Return `cameras`, those that the views were made of, at their present poses."""
        found = self.views(range(len(cameras))).w2c.double().cpu().numpy()
        return tuple(replace(c, R=w2c[:3, :3], t=w2c[:3, 3]) for c, w2c in zip(cameras, found, strict=True))


def refine_pose(
    render_view: Callable[[Views], Tensor],
    camera: Camera,
    image: Float32,
    background: NDArray[np.bool_],
    depth_m: float,
    settings: Refinement = REFINEMENT,
    device: str = "cpu",
) -> Camera:
    """Return the camera near `camera` that makes mean |g rendered + o - image| smallest over `background` [H, W].

    Gain g and offset o are those of least squares at each step: the image is of a camera that nobody calibrated, and
    brightness that no pose explains would move it. The pose is exp(xi) w2c with xi = (rotation, translation / depth_m);
    the best of all steps is returned, the first included, so that refinement never ends worse than it began.
    `render_view` renders one view [1, H, W], differentiable in `views.w2c`. Raises UserError where the mask is empty.
    """
    shape = (camera.height, camera.width)
    if image.shape != shape or background.shape != shape or not background.any():
        found = f"{image.shape}, {background.shape}, {int(background.sum())} background pixels"
        expected = f"an image and a mask of shape {shape} with background pixels"
        raise problem("pose refinement", expected, found, "check it")
    start = Views.from_cameras([camera], device=device)
    target = torch.as_tensor(image, device=device)[None]
    weight = torch.as_tensor(background, dtype=target.dtype, device=device)[None] / float(background.sum())
    xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    units = torch.tensor([1.0, 1.0, 1.0, depth_m, depth_m, depth_m], dtype=torch.float64)
    adam = torch.optim.Adam([xi], lr=settings.lr)
    best, best_loss = start.w2c[0].cpu().numpy(), math.inf
    with one_torch_thread():
        for step in range(settings.steps + 1):
            w2c = rigid_motion(xi * units).to(device) @ start.w2c
            rendered = render_view(replace(start, w2c=w2c))
            gain, offset = _line(rendered.detach(), target, weight)
            loss = ((gain * rendered + offset - target).abs() * weight).sum()
            if (value := loss.item()) < best_loss:
                best, best_loss = w2c[0].detach().cpu().numpy(), value
            share = 0.5 * (1 + math.cos(math.pi * step / max(settings.steps, 1)))
            adam.param_groups[0]["lr"] = settings.lr_last + (settings.lr - settings.lr_last) * share
            adam.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            adam.step()
    return replace(camera, R=best[:3, :3], t=best[:3, 3])


def _line(x: Tensor, y: Tensor, weight: Tensor) -> tuple[float, float]:
    """Return g and o of least squares for y = g x + o; `weight` has the sum 1. Where x is even, g is 1."""
    mean_x, mean_y = (float((v * weight).sum()) for v in (x, y))
    spread = float((weight * (x - mean_x) ** 2).sum())
    gain = float((weight * (x - mean_x) * (y - mean_y)).sum()) / spread if spread > 1e-12 else 1.0
    return gain, mean_y - gain * mean_x
