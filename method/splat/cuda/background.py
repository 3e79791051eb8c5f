"""The background of fixed views on a CUDA device: see `method/splat/background.py`, which this is the twin of.

The projection, the sorted lists and the images of all views are kept. A render composites only the tiles that its own
Gaussians touch, from the lists of both; the others are copied.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from spike4dgs.method.splat.cuda.prepare import Lists, sort_pairs
from spike4dgs.method.splat.cuda.render import Behind, Job, blend, project_splats
from spike4dgs.method.splat.types import PixelFilter, RenderOutput, Splats, Views


@dataclass(frozen=True, eq=False)
class Layer:
    """A background in V views."""

    views: Views  # on the device
    pixel_filter: PixelFilter
    records: Tensor  # [B, 6] float64
    layers: Tensor  # [B, F] float32
    lists: Lists
    image: Tensor  # [V, F, H, W]
    alpha: Tensor  # [V, H, W]


@torch.no_grad()
def make_layer(splats: Splats, views: Views, pixel_filter: PixelFilter) -> Layer:
    """Render the background once into all views."""
    views = views.to(splats.means.device)
    p = project_splats(splats, views, pixel_filter)
    layers = splats.colors[p.seen.index].float()
    lists = sort_pairs(p.grid, p.pairs.keys, p.pairs.rows, torch.full_like(p.pairs.rows, -1))
    image, alpha = blend(p.records, layers, Job(lists, p.pairs.starts))
    return Layer(views, pixel_filter, p.records, layers, lists, image, alpha)


def render_over(layer: Layer, splats: Splats, chosen: Sequence[int]) -> RenderOutput:
    """Render `splats` and the background into the views `chosen`: see `Background.render`."""
    device = splats.means.device
    pick = torch.tensor(list(chosen)).to(device, non_blocking=True)  # the copy is queued; nothing waits for the device
    p = project_splats(splats, layer.views.some(chosen), layer.pixel_filter)
    own = p.pairs
    touched = torch.unique(own.keys >> 32)
    keys, rows = _behind_pairs(layer, pick, touched)
    slots = torch.cat([torch.full_like(rows, -1), torch.arange(len(own.keys), device=device)])
    both = (torch.cat([keys, own.keys]), torch.cat([rows, own.rows + len(layer.records)]))
    job = Job(
        sort_pairs(p.grid, *both, slots, touched),
        own.starts,
        Behind(layer.records, layer.layers, layer.image[pick], layer.alpha[pick]),
    )
    image, alpha = blend(p.records, splats.colors[p.seen.index].float(), job)
    return RenderOutput(image.permute(0, 2, 3, 1), alpha, None, p.radii, p.means2d)


def _behind_pairs(layer: Layer, pick: Tensor, touched: Tensor) -> tuple[Tensor, Tensor]:
    """Return (keys, rows) of the background's pairs in the tiles `touched` of the views `pick`, in their order."""
    lists = layer.lists
    per_view = lists.grid.across * lists.grid.down
    tile = pick[touched // per_view] * per_view + touched % per_view  # [K] in the grid of all views
    counts = lists.offsets[tile + 1] - lists.offsets[tile]
    total = int(counts.sum())
    of = torch.repeat_interleave(torch.arange(len(tile), device=tile.device), counts, output_size=total)
    first = torch.cumsum(counts, 0) - counts
    at = lists.offsets[tile[of]] + torch.arange(total, device=tile.device) - first[of]
    return (touched[of] << 32) | (lists.keys[at] & 0xFFFFFFFF), lists.rows[at]
