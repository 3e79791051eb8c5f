"""Gaussians that stay as they are before fixed cameras: projected and listed once, then drawn with others that change.

A fit of a mostly static scene renders the same Gaussians into the same views again and again. A `Background` keeps, for
each view, what they project to, their tile lists and their image. A tile that no other Gaussian touches is copied
from that image; in the others both lists are sorted and composited together, so that the result is what rendering all
Gaussians at once gives, to the bit. No gradient flows to the background.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spike4dgs.method.splat import api, cpu
from spike4dgs.method.splat.kernels.blend_ir import TILE_HEIGHT, TILE_WIDTH
from spike4dgs.method.splat.kernels.jit import kernel
from spike4dgs.method.splat.types import RenderOutput, Splats, Views

Array = np.ndarray
NEAR, EPS2D = 0.01, 0.3  # `render`'s defaults


@dataclass(frozen=True, eq=False)
class _Still:
    """The background in one view."""

    projection: cpu.Projection
    colors: Array  # [passes, N * channels]
    image: Array  # [L, H, W]
    alpha: Array  # [H, W]


class Background:
    """Splats seen by views, none of which changes. Splats that are drawn with it need the same number of channels."""

    def __init__(self, splats: Splats, views: Views) -> None:
        self.splats = Splats(*(t.detach() for t in (*splats.geometry, splats.colors)))
        self.views = views
        self._still: dict[int, _Still] = {}

    def __len__(self) -> int:
        return len(self.splats)

    def render(self, splats: Splats, chosen: Sequence[int]) -> RenderOutput:
        """Draw `splats` [N] and the background into the views `chosen`, differentiable in `splats`; no depth.

        `radii` and `means2d` are those of `splats` alone. Raises UserError for values that are not finite.
        """
        views = Views(self.views.w2c[list(chosen)], self.views.K[list(chosen)], self.views.width, self.views.height)
        if splats.means.device.type != "cpu":
            out = api.render(join(self.splats, splats), views)
            return replace(out, radii=out.radii[:, len(self) :])
        if not torch.isfinite(splats.colors.detach().sum()):
            cpu.require_finite(splats)
        tensors = _tensors(splats)
        wanted = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
        means2d = torch.zeros(len(views), len(splats), 2, requires_grad=wanted)
        radii = torch.zeros(len(views), len(splats))
        image, alpha = _Over.apply(*(t.float() for t in tensors), means2d, self, tuple(chosen), radii)
        return RenderOutput(image.permute(0, 2, 3, 1), alpha, None, radii, means2d)

    def settings(self) -> cpu.Settings:
        """What the kernels are asked for."""
        return cpu.Settings(self.views.width, self.views.height, NEAR, EPS2D, antialiased=False, depth=False)

    def still(self, view: int) -> _Still:
        """The background in a view, made when it is first asked for."""
        if view not in self._still:
            s, n = self.settings(), len(self)
            geometry = tuple(t.float().contiguous().numpy() for t in self.splats.geometry)
            camera = cpu.camera_entries(self.views.w2c[view], self.views.K[view])
            p = cpu.project_view(geometry, camera, s, np.empty((n, 2), np.float32), np.empty(n, np.float32))
            colors = cpu.pack_colors(self.splats.colors.float().numpy(), None)
            frame = cpu.composite_view(p, colors, cpu.chunking(self.splats.colors.shape[1])[0], s)
            self._still[view] = _Still(p, colors, frame.image, frame.alpha)
        return self._still[view]


def join(a: Splats, b: Splats) -> Splats:
    """The Gaussians of `a` followed by those of `b`."""
    return Splats(*(torch.cat(pair) for pair in zip(_tensors(a), _tensors(b), strict=True)))


def _tensors(splats: Splats) -> tuple[Tensor, ...]:
    return (*splats.geometry, splats.colors)


def _join(still: cpu.Projection, own: cpu.Projection, across: int) -> cpu.Projection:
    """Both sets of Gaussians, the background's first, with lists for the tiles that `own` touches.

    A Gaussian of the background has, instead of gradient records of its own, the record of its tile behind all others:
    it is written to, by one thread at a time, and never read. `across`: tiles in a row.
    """
    n, counts = len(still.keys), np.diff(own.offsets)
    offsets = np.concatenate([[0], np.cumsum(np.where(counts > 0, counts + np.diff(still.offsets), 0))])
    pairs = np.empty(offsets[-1], np.uint64)
    _merge(still.pairs, still.offsets, own.pairs, own.offsets, n, offsets, pairs)
    tiles, slots = np.empty((n + len(own.keys), 4), np.int32), np.empty(n + len(own.slots), np.int32)
    tiles[:n], tiles[n:] = (0, across, 0, 1), own.tiles
    slots[:n], slots[n:] = len(own.pairs), own.slots
    records = cpu.aligned((n + len(own.keys), 8), np.float64)
    records[:n], records[n:] = still.records, own.records
    keys, depths = np.concatenate([still.keys, own.keys]), np.concatenate([still.depths, own.depths])
    return cpu.Projection(own.camera, records, keys, depths, tiles, slots, pairs, offsets)


@kernel
def _merge(
    still_pairs: Any, still_offsets: Any, own_pairs: Any, own_offsets: Any, n: int, offsets: Any, pairs: Any
) -> None:
    """Fill each tile's list with the background's pairs and the others', whose index moves up by n."""
    for tile in range(len(offsets) - 1):
        at = offsets[tile]
        if offsets[tile + 1] == at:
            continue
        for k in range(still_offsets[tile], still_offsets[tile + 1]):
            pairs[at] = still_pairs[k]
            at += 1
        for k in range(own_offsets[tile], own_offsets[tile + 1]):
            pairs[at] = own_pairs[k] + np.uint64(n)
            at += 1


def _untouched(own: cpu.Projection, s: cpu.Settings) -> Array:
    """Pixels [H, W] of the tiles that no Gaussian of `own` touches."""
    across = -(-s.width // TILE_WIDTH)
    empty = (np.diff(own.offsets) == 0).reshape(-1, across)
    return empty.repeat(TILE_HEIGHT, 0).repeat(TILE_WIDTH, 1)[: s.height, : s.width]


class _Over(torch.autograd.Function):
    """Tensors in, image [C, F, H, W] and alpha [C, H, W] out; `probe` only receives dL/dmeans2d."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, probe: Tensor,
        background: Background, chosen: tuple[int, ...], radii: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        s, channels = background.settings(), colors.shape[1]
        geometry = tuple(t.detach().contiguous().numpy() for t in (means, quats, scales, opacities))
        packed = cpu.pack_colors(colors.detach().contiguous().numpy(), None)
        images, alphas, frames = [], [], []
        with cpu.busy:
            for c, view in enumerate(chosen):
                still = background.still(view)
                camera = still.projection.camera
                own = cpu.project_view(geometry, camera, s, probe.detach()[c].numpy(), radii[c].numpy())
                both = np.concatenate([still.colors, packed], axis=1)
                frame = cpu.composite_view(
                    _join(still.projection, own, -(-s.width // TILE_WIDTH)), both, cpu.chunking(channels)[0], s
                )
                rest = _untouched(own, s)
                frame.image[:, rest], frame.alpha[rest] = still.image[:, rest], still.alpha[rest]
                images.append(frame.image[:channels])
                alphas.append(frame.alpha)
                frames.append((own, frame))
        ctx.frames, ctx.geometry, ctx.settings, ctx.channels = frames, geometry, s, channels
        return torch.from_numpy(np.stack(images)), torch.from_numpy(np.stack(alphas))

    @staticmethod
    def backward(ctx: Any, d_image: Tensor, d_alpha: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        n, s = len(ctx.geometry[0]), ctx.settings
        outputs = [np.zeros(a.shape, np.float32) for a in ctx.geometry] + [np.zeros((n, ctx.channels), np.float32)]
        d_centers = np.zeros((len(ctx.frames), n, 2), np.float32)
        with cpu.busy:
            for c, (own, frame) in enumerate(ctx.frames):
                layers = np.zeros(frame.image.shape, np.float32)
                layers[: ctx.channels] = d_image[c].numpy()
                count, tiles = len(own.pairs), len(own.offsets) - 1
                d_opaque = np.ascontiguousarray(d_alpha[c].numpy())
                sums = cpu.record_sums(frame, s, layers, d_opaque, cpu.chunking(ctx.channels)[0], count + tiles)
                cpu.chain(
                    own,
                    ctx.geometry,
                    s,
                    np.ascontiguousarray(sums[:, :count]),
                    (*outputs, d_centers[c]),
                    np.zeros((0, 4)),
                )
        return (*(torch.from_numpy(a) for a in outputs), torch.from_numpy(d_centers), None, None, None)
