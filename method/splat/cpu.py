"""Back end "cpu": the numba kernels behind a torch autograd function.

All views at once, on all threads: project every Gaussian (float64), count and fill tile lists, sort and composite tile
by tile (float32); backward replays the tiles front to back, then chains to the parameters.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spike4dgs.method.splat.kernels import project as project_kernels
from spike4dgs.method.splat.kernels import project_gradient
from spike4dgs.method.splat.kernels import tiles as tile_kernels
from spike4dgs.method.splat.kernels.blend_ir import PLANE, TILE_HEIGHT, TILE_WIDTH
from spike4dgs.method.splat.kernels.jit import announce_compilation
from spike4dgs.method.splat.kernels.project import Cameras, Geometry, Projected
from spike4dgs.method.splat.kernels.project_gradient import Gradients, Records
from spike4dgs.method.splat.kernels.raster import Layer, Lists, raster_kernels, record_width
from spike4dgs.method.splat.kernels.threads import aligned, get_threads, run, useful_threads
from spike4dgs.method.splat.kernels.tiles import AHEAD, BATCH, MAX_BLOCKS
from spike4dgs.method.splat.kernels.vector_ir import host_lanes
from spike4dgs.method.splat.types import (
    PixelFilter,
    RenderOutput,
    Splats,
    Views,
    not_finite,
    require_finite,
    require_finite_cameras,
)

Array = np.ndarray


class _Scratch(threading.local):
    """The scratch memory of a caller's threads: several callers may render at once."""

    def __init__(self) -> None:
        self.by_thread: dict[int, tuple[Array, ...]] = {}


_scratch = _Scratch()


@dataclass(frozen=True)
class Settings:
    """The options of one call of `render`, in the kernels' terms."""

    width: int
    height: int
    pixel_filter: PixelFilter
    depth: bool

    @property
    def tiles(self) -> tuple[int, int]:
        """Tiles across and down the image."""
        return -(-self.width // TILE_WIDTH), -(-self.height // TILE_HEIGHT)

    def cameras(self, w2c: Tensor, K: Tensor, lenses: Tensor | None) -> Cameras:
        """Return the kernels' cameras from [V, 4, 4], [V, 3, 3] and the lenses [V, 10] if there are any."""
        pose, k, f = w2c.detach().double().numpy(), K.detach().double().numpy(), self.pixel_filter
        entries = [pose[:, :3, :3].reshape(-1, 9), pose[:, :3, 3], k[:, [0, 1, 0, 1], [0, 1, 2, 2]]]
        rows = np.empty((0, 10)) if lenses is None else lenses.detach().double().contiguous().numpy()
        return Cameras(np.concatenate(entries, axis=1), rows, self.width, self.height, f.variance, f.compensated)


@dataclass(frozen=True, eq=False)
class Projection:
    """N Gaussians in V views: where they are rendered, and which tiles they touch. P: Gaussian-tile pairs."""

    cameras: Cameras
    records: Array  # [V, N, 8] float64
    keys: Array  # [V, N] uint32
    depths: Array  # [V, N] float32
    tiles: Array  # [V, N, 4] int32
    slots: Array  # [V, N + 1] int32
    pairs: Array  # [P] uint64
    offsets: Array  # [V * tiles + 1] int64


@dataclass(frozen=True, eq=False)
class Frames:
    """V rendered views, and the arrays that their gradient needs. L: kernel channels in all."""

    projection: Projection
    lists: Lists
    layer: Layer
    processed: Array  # [chunks, V * tiles] int64
    image: Array  # [V, L, H, W] float32
    alpha: Array  # [V, H, W] float32


def _thread_memory(thread: int) -> tuple[Array, ...]:
    """Return the scratch of one of the threads that work for this caller, kept for the next call."""
    kept = _scratch.by_thread
    if thread not in kept:
        kept[thread] = _new_memory()
    return kept[thread]


def _new_memory() -> tuple[Array, ...]:
    """Return a thread's scratch: projection rows, lanes, tile planes, block list, digits."""
    rows = max(project_kernels.ROWS, project_gradient.ROWS) * project_kernels.BLOCK
    planes = 8 * PLANE  # T, R, alpha gradient and up to 4 colours, and room for a vector that overhangs the last
    block_list = (np.empty(MAX_BLOCKS, np.int32), np.empty(MAX_BLOCKS, np.float32), np.empty(MAX_BLOCKS, np.float32))
    runs = np.empty(BATCH, np.int32), np.zeros(BATCH + AHEAD, np.int32)  # the Gaussians' ends in the list, and which
    lanes = np.empty(project_kernels.BLOCK, np.int64)
    digits = np.empty(1024, np.int32)
    return np.empty(rows), lanes, aligned((planes,), np.float32), *block_list, *runs, digits


def chunking(channels: int) -> tuple[int, int]:
    """Return (channels per kernel pass, passes). Kernels exist for 1, 2 and 4 channels."""
    per_pass = channels if channels <= 2 else 4
    return per_pass, -(-channels // per_pass)


def pack_colors(colors: Array, depths: Array | None) -> Array:
    """Return colours [N, F] and depths [V, N], if any, as [V or 1, chunks, N * channels] float32, padded with zeros."""
    layers = colors.shape[1] + (depths is not None)
    per_pass, passes = chunking(layers)
    if depths is None and passes == 1 and per_pass == layers and colors.dtype == np.float32:
        return np.ascontiguousarray(colors).reshape(1, 1, -1)
    packed = np.zeros((1 if depths is None else len(depths), passes, len(colors), per_pass), np.float32)
    for channel in range(colors.shape[1]):
        packed[:, channel // per_pass, :, channel % per_pass] = colors[:, channel]
    if depths is not None:
        packed[:, (layers - 1) // per_pass, :, (layers - 1) % per_pass] = depths
    return packed.reshape(len(packed), passes, -1)


def no_layer() -> Layer:
    """Return an empty layer."""
    order, keys, longs = np.empty(0, np.int32), np.empty(0, np.uint32), np.empty(0, np.int64)
    images = np.empty((0, 0, 0, 0), np.float32), np.empty((0, 0, 0), np.float32)
    return Layer(longs, np.empty((0, 0)), np.empty((0, 0), np.float32), order, keys, longs, *images)


def project_views(geometry: Geometry, cameras: Cameras, s: Settings, centers: Array, radii: Array) -> Projection:
    """Project into V views and list the tiles; fills centers [V, N, 2] and radii [V, N]. Raises UserError for NaN."""
    views, n = len(cameras.entries), len(geometry.means)
    across, down = s.tiles
    blocks = -(-n // project_kernels.BLOCK)
    records = aligned((views, n, 8), np.float64)
    keys, depths = np.empty((views, n), np.uint32), np.empty((views, n), np.float32)
    tiles, slots = np.empty((views, n, 4), np.int32), np.zeros((views, n + 1), np.int32)
    histogram = np.empty((views, blocks, 1 + across * down), np.int32)
    invalid, offsets = np.empty((views, blocks), np.int64), np.empty(views * across * down + 1, np.int64)
    out = Projected(records, keys, depths, centers, radii, tiles, histogram, invalid)
    announce_compilation(project_kernels.project_forward, "CPU splatting")
    scratch = [(_thread_memory(t)[0],) for t in range(useful_threads(views * blocks, 16))]
    run(project_kernels.project_forward, (geometry, cameras, out), scratch)
    if n and invalid.max() >= 0:
        raise not_finite("geometry", int(invalid.max()))
    pairs = np.empty(tile_kernels.tile_offsets(histogram, offsets), np.uint64)
    run(
        tile_kernels.fill_tiles,
        (keys, tiles, across, histogram, slots, pairs),
        [()] * useful_threads(views * blocks, 64),
    )
    return Projection(cameras, records, keys, depths, tiles, slots, pairs, offsets)


def composite(p: Projection, colors: Array, channels: int, layer: Layer, s: Settings) -> Frames:
    """Composite all views, nearest first. `colors` come from `pack_colors`, for kernels of so many channels."""
    views, passes, pairs = len(p.keys), colors.shape[1], len(p.pairs)
    image = np.empty((views, passes * channels, s.height, s.width), np.float32)
    alpha = np.empty((views, s.height, s.width), np.float32)
    items = len(p.offsets) - 1
    processed = np.empty((passes, items), np.int64)
    lists = Lists(p.records.reshape(views, -1), p.keys, colors, np.empty(pairs, np.int32), p.offsets)
    forward, _ = raster_kernels(host_lanes(), channels)
    longest = int(np.diff(p.offsets).max())
    arguments = (lists, p.pairs, layer, s.width, s.height, image, alpha, processed)
    memory = [_thread_memory(t)[2:9] for t in range(get_threads())]
    run(forward, arguments, [(*m, np.empty(longest, np.uint64)) for m in memory])
    return Frames(p, lists, layer, processed, image, alpha)


def record_sums(frames: Frames, s: Settings, d_image: Array, d_alpha: Array, channels: int) -> Array:
    """Return the gradient records [passes, P, record width] of the Gaussian-tile pairs."""
    p, width = frames.projection, record_width(channels)
    passes, pairs = len(frames.processed), len(p.pairs)
    sums = aligned((passes, pairs * width), np.float32)
    _, backward = raster_kernels(host_lanes(), channels)
    images = (s.width, s.height, frames.image, frames.alpha, frames.processed, d_image, d_alpha)
    arguments = (frames.lists, p.slots, p.tiles, frames.layer, *images, sums)
    run(backward, arguments, [_thread_memory(t)[2:8] for t in range(get_threads())])
    return sums.reshape(passes, pairs, width)


def differentiate(
    frames: Frames, geometry: Geometry, channels: int, s: Settings, d_image: Array, d_alpha: Array, posed: bool
) -> Gradients:
    """Return the gradients of the views' images [V, L, H, W] and alphas [V, H, W]; `posed`: of the cameras too."""
    p, dtype, (views, n) = frames.projection, geometry.means.dtype, frames.projection.keys.shape
    sums = record_sums(frames, s, d_image, d_alpha, chunking(channels + s.depth)[0])
    means, quats, scales, opacities = (np.zeros(a.shape, dtype) for a in geometry)
    colors, centers = np.zeros((n, channels), np.float32), np.empty((views, n, 2), dtype)
    blocks = -(-n // project_kernels.BLOCK)
    poses = np.empty((views, blocks if posed else 0, 12))
    gradients = Gradients(means, quats, scales, opacities, colors, centers, poses)
    records = Records(p.keys, p.slots, sums, channels if s.depth else -1)
    scratch = [_thread_memory(t)[:2] for t in range(useful_threads(views * blocks, 16))]
    run(project_gradient.project_backward, (geometry, p.cameras, records, gradients), scratch)
    return gradients


class _Rasterize(torch.autograd.Function):
    """Tensors in, layers [C, H, W, F (+ depth)] and alpha [C, H, W] out; `probe` only receives dL/dmeans2d."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, w2c: Tensor,
        probe: Tensor, K: Tensor, lenses: Tensor | None, settings: Settings, layer: Layer, radii: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        geometry = Geometry(*(t.detach().contiguous().numpy() for t in (means, quats, scales, opacities)))
        cameras, layers = settings.cameras(w2c, K, lenses), colors.shape[1] + settings.depth
        p = project_views(geometry, cameras, settings, probe.detach().numpy(), radii.numpy())
        packed = pack_colors(colors.detach().numpy(), p.depths if settings.depth else None)
        frames = composite(p, packed, chunking(layers)[0], layer, settings)
        ctx.frames, ctx.geometry, ctx.settings = frames, geometry, settings
        ctx.pose_dtype, ctx.colors_dtype, ctx.channels = w2c.dtype, colors.dtype, colors.shape[1]
        image, alpha = torch.from_numpy(frames.image[:, :layers]), torch.from_numpy(frames.alpha)
        ctx.save_for_backward(means, quats, scales, opacities, colors, image, alpha)
        return image, alpha

    @staticmethod
    def backward(ctx: Any, d_image: Tensor, d_alpha: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        _ = ctx.saved_tensors  # the arrays share their memory: torch raises where one was changed since
        frames, posed = ctx.frames, ctx.needs_input_grad[5]
        layers = d_image.numpy()
        if layers.shape != frames.image.shape:
            layers = np.zeros(frames.image.shape, np.float32)
            layers[:, : d_image.shape[1]] = d_image.numpy()
        images = np.ascontiguousarray(layers), np.ascontiguousarray(d_alpha.numpy())
        total = differentiate(frames, ctx.geometry, ctx.channels, ctx.settings, *images, posed)
        means, quats, scales, opacities, colors, centers, poses = (torch.from_numpy(a) for a in total)
        d_w2c = None
        if posed:
            d_w2c = torch.zeros(len(poses), 4, 4, dtype=ctx.pose_dtype)
            d_w2c[:, :3] = torch.from_numpy(np.stack([pose.sum(0) for pose in total.poses])).reshape(-1, 3, 4)
        own = (means, quats, scales, opacities, colors.to(ctx.colors_dtype), d_w2c, centers)
        return (*own, None, None, None, None, None)


def render_cpu(splats: Splats, views: Views, pixel_filter: PixelFilter, depth: bool) -> RenderOutput:
    """Render with the back end "cpu": see `render` for the arguments."""
    wide = any(t.dtype == torch.float64 for t in splats.geometry)
    settings = Settings(views.width, views.height, pixel_filter, depth)
    return rasterize(splats, views, settings, torch.float64 if wide else torch.float32, no_layer())


def rasterize(splats: Splats, views: Views, settings: Settings, dtype: torch.dtype, layer: Layer) -> RenderOutput:
    """Render splats, whose geometry is taken as `dtype`, together with a layer in the same views."""
    require_finite_cameras(views)
    if not torch.isfinite(splats.colors.detach().sum()):  # the geometry is checked while it is projected
        require_finite(splats)
    geometry = [t.to(dtype) for t in splats.geometry]
    wanted = torch.is_grad_enabled() and any(t.requires_grad for t in (*splats.tensors, views.w2c))
    means2d = torch.zeros(len(views), len(splats), 2, dtype=dtype, requires_grad=wanted)
    radii = torch.zeros(len(views), len(splats))
    cameras = views.w2c, means2d, views.K, views.lenses
    layers, alpha = _Rasterize.apply(*geometry, splats.colors, *cameras, settings, layer, radii)
    layers = layers.permute(0, 2, 3, 1)
    image, far = (layers[..., :-1], layers[..., -1]) if settings.depth else (layers, None)
    return RenderOutput(image, alpha, far, radii, means2d)
