"""Gaussians that never change, in views that never change: projected and listed once, rendered with others that move.

A fit of a mostly static scene renders the same Gaussians into the same views again and again. A `Background` keeps, for
each view, their projection, their tile lists and their image. A tile that no other Gaussian touches is copied from that
image. In the other tiles both lists are sorted and composited together, so the result is what rendering all Gaussians
at once gives, to the bit. No gradient flows to the background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spike4dgs.method.splat import cpu
from spike4dgs.method.splat.cuda.background import Layer as DeviceLayer
from spike4dgs.method.splat.cuda.background import make_layer, render_over
from spike4dgs.method.splat.kernels.blend_ir import TILE_HEIGHT, TILE_WIDTH
from spike4dgs.method.splat.kernels.jit import kernel
from spike4dgs.method.splat.kernels.project import Geometry
from spike4dgs.method.splat.types import CUSTOMARY, NEAR, PixelFilter, RenderOutput, Splats, Views

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class _Layer:
    """The background in one view."""

    projection: cpu.Projection
    colors: Array  # [passes, N * channels]
    image: Array  # [L, H, W]
    alpha: Array  # [H, W]


class Background:
    """Splats in views, neither of which changes. Splats rendered with it need the same number of channels."""

    def __init__(self, splats: Splats, views: Views, pixel_filter: PixelFilter = CUSTOMARY) -> None:
        self.splats = Splats(*(t.detach() for t in (*splats.geometry, splats.colors)))
        self.views, self.pixel_filter = views, pixel_filter
        self._layers: dict[int, _Layer] = {}
        self._on_device: DeviceLayer | None = None

    def __len__(self) -> int:
        return len(self.splats)

    def render(self, splats: Splats, chosen: Sequence[int]) -> RenderOutput:
        """Render `splats` [N] and the background into the views `chosen`, differentiable in `splats`; no depth.

        `radii` and `means2d` are those of `splats` alone. Raises UserError for values that are not finite.
        """
        if splats.means.device.type != "cpu":
            self._on_device = self._on_device or make_layer(self.splats, self.views, self.pixel_filter)
            return render_over(self._on_device, splats, chosen)
        if not torch.isfinite(splats.colors.detach().sum()):
            cpu.require_finite(splats)
        tensors = _tensors(splats)
        wanted = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
        means2d = torch.zeros(len(chosen), len(splats), 2, requires_grad=wanted)
        radii = torch.zeros(len(chosen), len(splats))
        image, alpha = _Over.apply(*(t.float() for t in tensors), means2d, self, tuple(chosen), radii)
        return RenderOutput(image.permute(0, 2, 3, 1), alpha, None, radii, means2d)

    def settings(self) -> cpu.Settings:
        """Return the kernels' settings: the background's filter, in the size of the views."""
        f = self.pixel_filter
        return cpu.Settings(self.views.width, self.views.height, NEAR, f.variance, f.compensated, depth=False)

    def layer(self, view: int) -> _Layer:
        """Return the background in a view. It is rendered on the first call."""
        if view not in self._layers:
            s, n = self.settings(), len(self)
            geometry = Geometry(*(t.float().contiguous().numpy() for t in self.splats.geometry))
            camera = cpu.camera_entries(self.views.w2c[view], self.views.K[view])
            p = cpu.project_view(geometry, camera, s, np.empty((n, 2), np.float32), np.empty(n, np.float32))
            colors = cpu.pack_colors(self.splats.colors.float().numpy(), None)
            frame = cpu.composite_view(p, colors, cpu.chunking(self.splats.colors.shape[1])[0], s)
            self._layers[view] = _Layer(p, colors, frame.image, frame.alpha)
        return self._layers[view]


def join(a: Splats, b: Splats) -> Splats:
    """Return the Gaussians of `a` followed by those of `b`."""
    return Splats(*(torch.cat(pair) for pair in zip(_tensors(a), _tensors(b), strict=True)))


def _tensors(splats: Splats) -> tuple[Tensor, ...]:
    return (*splats.geometry, splats.colors)


def _join(behind: cpu.Projection, own: cpu.Projection, s: cpu.Settings) -> cpu.Projection:
    """Return both sets of Gaussians, the background's first, with lists for the tiles that `own` touches.

    A Gaussian of the background has no gradient records of its own. It writes to the record of its tile, which follows
    all others; one thread at a time writes there, and nobody reads it.
    """
    n, counts = len(behind.keys), np.diff(own.offsets)
    offsets = np.concatenate([[0], np.cumsum(np.where(counts > 0, counts + np.diff(behind.offsets), 0))])
    pairs = np.empty(offsets[-1], np.uint64)
    _merge(behind.pairs, behind.offsets, own.pairs, own.offsets, n, offsets, pairs)
    tiles, slots = np.empty((n + len(own.keys), 4), np.int32), np.empty(n + len(own.slots), np.int32)
    tiles[:n], tiles[n:] = (0, s.tiles[0], 0, 1), own.tiles
    slots[:n], slots[n:] = len(own.pairs), own.slots
    records = cpu.aligned((n + len(own.keys), 8), np.float64)
    records[:n], records[n:] = behind.records, own.records
    keys, depths = np.concatenate([behind.keys, own.keys]), np.concatenate([behind.depths, own.depths])
    return cpu.Projection(own.camera, records, keys, depths, tiles, slots, pairs, offsets)


@kernel
def _merge(
    behind_pairs: Any, behind_offsets: Any, own_pairs: Any, own_offsets: Any, n: int, offsets: Any, pairs: Any
) -> None:
    """Fill each tile's list with the background's pairs and the others', whose index moves up by n."""
    for tile in range(len(offsets) - 1):
        at = offsets[tile]
        if offsets[tile + 1] == at:
            continue
        for k in range(behind_offsets[tile], behind_offsets[tile + 1]):
            pairs[at] = behind_pairs[k]
            at += 1
        for k in range(own_offsets[tile], own_offsets[tile + 1]):
            pairs[at] = own_pairs[k] + np.uint64(n)
            at += 1


def _untouched(own: cpu.Projection, s: cpu.Settings) -> Array:
    """Return the pixels [H, W] of the tiles that no Gaussian of `own` touches."""
    empty = (np.diff(own.offsets) == 0).reshape(-1, s.tiles[0])
    return empty.repeat(TILE_HEIGHT, 0).repeat(TILE_WIDTH, 1)[: s.height, : s.width]


class _Over(torch.autograd.Function):
    """Tensors in, image [C, F, H, W] and alpha [C, H, W] out; `probe` only receives dL/dmeans2d."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, probe: Tensor,
        background: Background, chosen: tuple[int, ...], radii: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        s, channels = background.settings(), colors.shape[1]
        geometry = Geometry(*(t.detach().contiguous().numpy() for t in (means, quats, scales, opacities)))
        packed = cpu.pack_colors(colors.detach().contiguous().numpy(), None)
        images, alphas, frames = [], [], []
        with cpu.busy:
            for c, view in enumerate(chosen):
                behind = background.layer(view)
                camera = behind.projection.camera
                own = cpu.project_view(geometry, camera, s, probe.detach()[c].numpy(), radii[c].numpy())
                both = np.concatenate([behind.colors, packed], axis=1)
                frame = cpu.composite_view(_join(behind.projection, own, s), both, cpu.chunking(channels)[0], s)
                rest = _untouched(own, s)
                frame.image[:, rest], frame.alpha[rest] = behind.image[:, rest], behind.alpha[rest]
                images.append(frame.image[:channels])
                alphas.append(frame.alpha)
                frames.append((own, frame))
        ctx.frames, ctx.geometry, ctx.settings, ctx.channels = frames, geometry, s, channels
        return torch.from_numpy(np.stack(images)), torch.from_numpy(np.stack(alphas))

    @staticmethod
    def backward(ctx: Any, d_image: Tensor, d_alpha: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        s, no_pose = ctx.settings, np.zeros((0, 4))
        total = cpu.zero_gradients(ctx.geometry, ctx.channels, len(ctx.frames))
        with cpu.busy:
            for c, (own, frame) in enumerate(ctx.frames):
                layers = np.zeros(frame.image.shape, np.float32)
                layers[: ctx.channels] = d_image[c].numpy()
                count, tiles = len(own.pairs), len(own.offsets) - 1
                d_opaque = np.ascontiguousarray(d_alpha[c].numpy())
                sums = cpu.record_sums(frame, s, layers, d_opaque, cpu.chunking(ctx.channels)[0], count + tiles)
                own_sums = np.ascontiguousarray(sums[:, :count])
                cpu.chain(own, ctx.geometry, s, own_sums, total._replace(centers=total.centers[c]), no_pose)
        return (*(torch.from_numpy(a) for a in total), None, None, None)
