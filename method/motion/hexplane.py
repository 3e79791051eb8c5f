"""HexPlane deformation as in 4DGS (Wu et al. 2024): six feature planes per level, a small MLP, additive changes.

A canonical Gaussian at x looks up a feature at (x, t): the PRODUCT over the planes xy, xz, yz, xt, yt, zt of bilinear
values, CONCATENATED over levels of rising spatial resolution; the time resolution is the same at all levels. A linear
layer and one head per parameter (ReLU, linear, ReLU, linear) turn it into changes of means, log-scales, raw
quaternions, logits and colours.

Defects of the published code that are not repeated here:

- t is normalised to the whole time axis. There t in [0, 1] meets a grid over [-1, 1], so half of each plane is dead.
- The heads' last layers start at zero: the deformation is exactly zero at first. There it is random.
- The box comes from the robust extent of the points, seen depth included, never from the camera array.
- `plane_tv` is total variation along both axes. There it is a second difference along one axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from spike4dgs.method.gaussians.optimizer import Decay
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.motion.base import Extent, Motion
from spike4dgs.method.motion.mlp import perceptron
from spike4dgs.method.settings import Settings, check_numbers
from spike4dgs.method.splat import Splats

SPATIAL_AXES = ((0, 1), (0, 2), (1, 2))  # the planes xy, xz, yz
_CHANGES = {"means": 3, "log_scales": 3, "quats": 4, "logits": 1, "colors": 1}


@dataclass(frozen=True)
class HexPlaneSettings(Settings):
    """Sizes, learning rates and regularisers of the motion `hexplane` (prefix `motion`)."""

    cell_px: float = 3.0  # finest spatial cell, in pixels of a view across the box
    levels: int = 2  # multires 1, 2
    cell_ticks: float = 40.0  # time cell: four images, as 4DGS's 75 cells of 300 frames have
    features: int = 16  # per plane and level, 4DGS's dynerf preset
    mlp_width: int = 32  # 4DGS: 128
    lr_grid: float = 1e-2
    lr_grid_last: float = 1e-3
    lr_deformation: float = 1e-3
    lr_deformation_last: float = 1e-4
    tv_weight: float = 2e-4  # the three weights of 4DGS's dynerf preset
    smooth_weight: float = 1e-3
    sparse_weight: float = 1e-4

    def __post_init__(self) -> None:
        wanted = {
            "cell_px above 0": (self.cell_px, self.cell_px > 0),
            "cell_ticks above 0": (self.cell_ticks, self.cell_ticks > 0),
            "levels of 1 or more": (self.levels, self.levels >= 1),
            "features of 1 or more": (self.features, self.features >= 1),
            "mlp_width of 1 or more": (self.mlp_width, self.mlp_width >= 1),
        }
        check_numbers("motion", wanted)


@dataclass(frozen=True)
class HexPlaneShape:
    """Sizes of the field."""

    spatial: tuple[int, ...]  # cells per axis at each level
    times: int  # cells of the time axis
    features: int  # per plane and level
    width: int  # of the MLP


class HexPlane(nn.Module):
    """Feature planes over a box and the clip. Planes are channel-last: space [3, R, R, F], time [3, T, R, F]."""

    def __init__(self, shape: HexPlaneShape, low: Tensor, high: Tensor, generator: torch.Generator) -> None:
        super().__init__()
        self.shape = shape
        self.low: Tensor
        self.high: Tensor
        self.register_buffer("low", low.float().clone())
        self.register_buffer("high", high.float().clone())
        f = shape.features
        # As published: time planes start at 1 (no influence), spatial planes uniform in [0.1, 0.5].
        # Of torch's device `meta`, `rand` and arithmetic would import torch's compiler: two seconds.
        drawn = [torch.empty(3, r, r, f).uniform_(generator=generator) for r in shape.spatial]
        self.space = nn.ParameterList([nn.Parameter(p if p.is_meta else 0.1 + 0.4 * p) for p in drawn])
        self.time = nn.ParameterList([nn.Parameter(torch.ones(3, shape.times, r, f)) for r in shape.spatial])

    def forward(self, means: Tensor, t: float) -> Tensor:
        """Return features [N, levels * F] of points [N, 3] at the time t in [0, 1]. Points outside take the border."""
        unit = (means - self.low) / (self.high - self.low)  # [N, 3], the box is [0, 1]^3
        if means.device.type == "cpu":
            from spike4dgs.method.motion.hexplane_cpu import sample_levels

            return sample_levels(unit, [self.rows_at(plane, t) for plane in self.time], list(self.space))
        levels = zip(self.space, self.time, strict=True)
        return torch.cat([sample_level(unit, space, self.rows_at(time, t)) for space, time in levels], -1)

    @staticmethod
    def rows_at(plane: Tensor, t: float) -> Tensor:
        """Return rows [3, R, F] of a time plane [3, T, R, F] at t in [0, 1]; 0 is the first row and 1 the last."""
        position = min(max(t, 0.0), 1.0) * (plane.shape[1] - 1)
        row = min(int(position), max(plane.shape[1] - 2, 0))
        if plane.shape[1] == 1:
            return plane[:, 0]
        return torch.lerp(plane[:, row], plane[:, row + 1], position - row)


def sample_level(unit: Tensor, space: Tensor, lines: Tensor) -> Tensor:
    """Return the products [N, F] of one level at unit points [N, 3]: planes [3, R, R, F], lines [3, R, F]."""
    grid = 2 * unit - 1
    product = torch.ones((), dtype=unit.dtype, device=unit.device)
    for plane, (a, b) in zip(space, SPATIAL_AXES, strict=True):
        product = product * _bilinear(plane, torch.stack([grid[:, b], grid[:, a]], -1))  # it wants the last axis first
    for axis, line in enumerate(lines):
        at = torch.stack([torch.zeros_like(grid[:, axis]), grid[:, axis]], -1)
        product = product * _bilinear(line[:, None], at)
    return product


def _bilinear(plane: Tensor, grid: Tensor) -> Tensor:
    """Return a plane [A, B, F] at grid [N, 2] in [-1, 1]: [N, F]."""
    image = plane.permute(2, 0, 1)[None]
    out = functional.grid_sample(image, grid[None, :, None], padding_mode="border", align_corners=True)
    return out[0, :, :, 0].T


def hexplane_shape(extent: Extent, settings: HexPlaneSettings) -> HexPlaneShape:
    """Return a shape as fine as images and clip ask: spatial cells by the view's width, time cells by the length."""
    finest = max(2, round(extent.width / settings.cell_px))
    spatial = tuple(max(2, finest >> (settings.levels - 1 - level)) for level in range(settings.levels))
    times = max(4, round(extent.n_ticks / settings.cell_ticks) + 1)
    return HexPlaneShape(spatial, times, settings.features, settings.mlp_width)


class HexPlaneMotion(Motion):
    """The motion `hexplane`: features, one linear layer, five heads. Means move in units of `scale` metres."""

    label = "4DGS"
    defaults = HexPlaneSettings()
    # 4DGS's preset for several views sees 3,000 and 15,000 single images: steps of four here.
    published = {"trainer.coarse_steps": 750, "trainer.fine_steps": 3750}

    def __init__(self, extent: Extent, settings: HexPlaneSettings, generator: torch.Generator) -> None:
        super().__init__()
        self.settings, self.scale = settings, extent.scale
        shape = hexplane_shape(extent, settings)
        self.planes = HexPlane(shape, extent.low, extent.high, generator)
        w = shape.width
        self.trunk = nn.Linear(shape.features * len(shape.spatial), w)
        self.hidden = nn.Linear(w, w * len(_CHANGES))  # the heads' first layers side by side
        self.last = nn.ModuleDict({name: nn.Linear(w, size) for name, size in _CHANGES.items()})
        for layer in (self.trunk, self.hidden):
            nn.init.xavier_uniform_(layer.weight, generator=generator)
            nn.init.zeros_(layer.bias)
        for parameter in self.last.parameters():
            nn.init.zeros_(parameter)

    def deform(self, gaussians: Gaussians, t: float) -> Gaussians:
        """Return the Gaussians at the time t in [0, 1]."""
        layers = [*self.trunk.parameters(), *self.hidden.parameters(), *self.last.parameters()]
        out = perceptron(self.planes(gaussians.means, t), layers)
        added = dict(zip(self.last, out, strict=True))
        added["means"], added["logits"] = added["means"] * self.scale, added["logits"][:, 0]
        if lamp := gaussians.colors.shape[1] - 1:  # what a lamp adds changes with the lamp alone
            added["colors"] = functional.pad(added["colors"], (0, lamp))
        return Gaussians.from_tensors({name: value + added[name] for name, value in gaussians.tensors().items()})

    def splats(self, gaussians: Gaussians, t: float) -> Splats:
        """Return the deformed Gaussians."""
        return self.deform(gaussians, t).splats()

    def groups(self) -> dict[str, tuple[list[nn.Parameter], Decay]]:
        """Return planes and MLP with their learning rates."""
        s = self.settings
        mlp = [*self.trunk.parameters(), *self.hidden.parameters(), *self.last.parameters()]
        return {
            "grid": (list(self.planes.parameters()), Decay(s.lr_grid, s.lr_grid_last)),
            "deformation": (mlp, Decay(s.lr_deformation, s.lr_deformation_last)),
        }

    def regularizer(self) -> Tensor:
        """Return w_tv * plane TV + w_smooth * time smoothness + w_sparse * time sparsity."""
        s, space, time = self.settings, list(self.planes.space), list(self.planes.time)
        smooth = s.smooth_weight * time_smoothness(time) + s.sparse_weight * time_sparsity(time)
        return s.tv_weight * plane_tv(space) + smooth


def plane_tv(space: Sequence[Tensor]) -> Tensor:
    """Return the total variation of the spatial planes: mean squared difference of neighbours, both axes.

    sum over the three planes of mean (P[i+1,j] - P[i,j])^2 + mean (P[i,j+1] - P[i,j])^2, averaged over levels, so that
    the weight means the same with any number of levels (the published code sums over them).
    """
    return torch.stack([3 * (_mean_square(p, 1, 1) + _mean_square(p, 1, 2)) for p in space]).mean()


def time_smoothness(time: Sequence[Tensor]) -> Tensor:
    """Return second differences along time: the sum over time planes of mean (P[t-1] - 2 P[t] + P[t+1])^2."""
    return torch.stack([3 * _mean_square(p, 2, 1) for p in time]).mean()


def time_sparsity(time: Sequence[Tensor]) -> Tensor:
    """Return the distance of the time planes from 1, where they have no influence: sum over planes of mean |1 - P|."""
    return torch.stack([3 * (1 - p).abs().mean() for p in time]).mean()


class _MeanSquare(torch.autograd.Function):
    """The mean squared difference along an axis; the gradient of torch's own operations takes three times as long."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, order: int, axis: int) -> Tensor:
        difference = x.diff(order, axis)
        ctx.save_for_backward(difference)
        ctx.order, ctx.axis = order, axis
        return difference.square().mean()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        (difference,) = ctx.saved_tensors
        shape = list(difference.shape)
        count = shape[ctx.axis]
        shape[ctx.axis] += ctx.order
        out, scaled = difference.new_zeros(shape), difference * (2 / difference.numel() * grads[0])
        for start, factor in enumerate(((-1, 1), (1, -2, 1))[ctx.order - 1]):
            out.narrow(ctx.axis, start, count).add_(scaled, alpha=factor)
        return out, None, None


def _mean_square(x: Tensor, order: int, axis: int) -> Tensor:
    found: Tensor = _MeanSquare.apply(x, order, axis)
    return found
