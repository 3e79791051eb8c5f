"""Gaussians that never change, in views that never change: projected and listed once, rendered with others that move.

A fit of a mostly static scene renders the same Gaussians into the same views again and again. A `Background` keeps, for
all views, their projection, their sorted lists and their image. A tile that no other Gaussian touches is copied from
that image. In the other tiles both lists are merged and composited together, so the result is what rendering all
Gaussians at once gives, to the bit. No gradient flows to the background.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.splat import cpu
from spike4dgs.method.splat.cuda.background import Layer as DeviceLayer
from spike4dgs.method.splat.cuda.background import make_layer, render_over
from spike4dgs.method.splat.kernels.project import Geometry
from spike4dgs.method.splat.kernels.raster import Layer
from spike4dgs.method.splat.types import CUSTOMARY, PixelFilter, RenderOutput, Splats, Views


class Background:
    """Splats in views, neither of which changes. Splats rendered with it need the same number of channels."""

    def __init__(self, splats: Splats, views: Views, pixel_filter: PixelFilter = CUSTOMARY) -> None:
        self.splats = Splats(*(t.detach() for t in splats.tensors))
        self.views, self.pixel_filter = views, pixel_filter
        self._layer: Layer | None = None
        self._on_device: DeviceLayer | None = None

    def __len__(self) -> int:
        return len(self.splats)

    def render(self, splats: Splats, chosen: Sequence[int]) -> RenderOutput:
        """Render `splats` [N] and the background into the views `chosen`, differentiable in `splats`; no depth.

        On the CPU both are projected in float32. `radii` and `means2d` are those of `splats` alone. Raises UserError
        for values that are not finite, and for another number of channels than the background's.
        """
        channels, own = splats.colors.shape[1], self.splats.colors.shape[1]
        if channels != own:
            fix = "give both the same channels"
            raise problem("Splats.colors", f"{own} channels, as the background has", f"{channels}", fix)
        if splats.means.device.type != "cpu":
            self._on_device = self._on_device or make_layer(self.splats, self.views, self.pixel_filter)
            return render_over(self._on_device, splats, chosen)
        views = self.views.some(chosen)
        settings = cpu.Settings(views.width, views.height, self.pixel_filter, depth=False)
        self._layer = self._layer or _make_layer(self.splats, self.views, settings)
        layer = self._layer._replace(chosen=np.array(list(chosen)))
        return cpu.rasterize(Splats(*splats.geometry, splats.colors.float()), views, settings, torch.float32, layer)


class Repeated:
    """The same Gaussians behind others, in views that may come back: a view that does gets a `Background` of its own.

    A test camera is rendered at hundreds of times; on a camera path no view comes back.
    """

    MOST = 9  # views that are remembered: an array's

    def __init__(self, splats: Splats, pixel_filter: PixelFilter) -> None:
        self.splats, self.pixel_filter = splats, pixel_filter
        self._kept: dict[bytes, Background | None] = {}  # the latest last; None: seen once

    def in_view(self, view: Views) -> Background | None:
        """Return the background in a single view, or None where it was not rendered lately."""
        tensors = [t for t in (view.w2c, view.K, view.lenses) if t is not None]
        key = b"".join(t.cpu().numpy().tobytes() for t in tensors) + f"{view.width}x{view.height}".encode()
        again, kept = key in self._kept, self._kept.pop(key, None)
        if again and kept is None:
            kept = Background(self.splats, view, self.pixel_filter)
        self._kept[key] = kept
        for oldest in list(self._kept)[: -self.MOST]:  # a copy: a viewer renders from several threads
            self._kept.pop(oldest, None)
        return kept


def join(a: Splats, b: Splats) -> Splats:
    """Return the Gaussians of `a` followed by those of `b`."""
    return Splats(*(torch.cat(pair) for pair in zip(a.tensors, b.tensors, strict=True)))


def _make_layer(splats: Splats, views: Views, s: cpu.Settings) -> Layer:
    """Render the background once into all views, and keep its lists."""
    geometry = Geometry(*(t.float().contiguous().numpy() for t in splats.geometry))
    cameras = s.cameras(views.w2c, views.K, views.lenses)
    sides = len(views), len(splats)
    colors = cpu.pack_colors(splats.colors.float().numpy(), None)
    p = cpu.project_views(geometry, cameras, s, np.empty((*sides, 2), np.float32), np.empty(sides, np.float32))
    frames = cpu.composite(p, colors, cpu.chunking(splats.colors.shape[1])[0], cpu.no_layer(), s)
    view = np.repeat(np.arange(len(views)), np.diff(p.offsets[:: s.tiles[0] * s.tiles[1]]))
    records, _, _, order, offsets = frames.lists
    return Layer(
        np.arange(len(views)), records, colors[0], order, p.keys[view, order], offsets, frames.image, frames.alpha
    )
