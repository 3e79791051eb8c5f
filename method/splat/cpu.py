"""Back end "cpu": the numba kernels behind a torch autograd function.

One view after another, each on all threads. Per view: project every Gaussian (float64), count and fill tile lists, sort
and composite tile by tile (float32); backward replays the tiles front to back, then chains to the parameters.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spike4dgs.method.splat.kernels import project as project_kernels
from spike4dgs.method.splat.kernels import project_gradient
from spike4dgs.method.splat.kernels import tiles as tile_kernels
from spike4dgs.method.splat.kernels.blend_ir import PLANE, TILE_HEIGHT, TILE_WIDTH
from spike4dgs.method.splat.kernels.jit import announce_compilation
from spike4dgs.method.splat.kernels.project import Geometry, Projected, View
from spike4dgs.method.splat.kernels.project_gradient import Gradients, Records
from spike4dgs.method.splat.kernels.raster import AHEAD, MAX_BLOCKS, raster_kernels, record_width
from spike4dgs.method.splat.kernels.threads import aligned, get_threads, run
from spike4dgs.method.splat.kernels.vector_ir import host_lanes
from spike4dgs.method.splat.types import RenderOutput, Splats, Views, not_finite, require_finite

Array = np.ndarray
busy = threading.Lock()  # the scratch memory is shared by all renders of the process


@dataclass(frozen=True)
class Settings:
    """The options of one call of `render`, in the kernels' terms."""

    width: int
    height: int
    near: float
    eps2d: float
    antialiased: bool
    depth: bool

    @property
    def tiles(self) -> tuple[int, int]:
        """Tiles across and down the image."""
        return -(-self.width // TILE_WIDTH), -(-self.height // TILE_HEIGHT)

    def view(self, camera: Array) -> View:
        """Return the kernels' view of a camera [16], see `camera_entries`."""
        return View(camera, self.width, self.height, self.near, self.eps2d, self.antialiased)


@dataclass(frozen=True, eq=False)
class Frame:
    """One rendered view, and the arrays that its gradient needs. P: Gaussian-tile pairs; L: kernel channels in all."""

    camera: Array  # [16] float64, see camera_entries
    records: Array  # [N * 8] float64
    keys: Array  # [N] uint32
    tiles: Array  # [N, 4] int32
    slots: Array  # [N + 1] int32
    order: Array  # [P + AHEAD] int32, tile by tile, nearest first
    offsets: Array  # [tiles + 1] int64
    colors: Array  # [chunks, N * channels] float32
    processed: Array  # [chunks, tiles] int64
    image: Array  # [L, H, W] float32
    alpha: Array  # [H, W] float32


@cache
def _thread_memory(thread: int) -> tuple[Array, ...]:
    """Return a thread's scratch: projection rows, lanes, tile planes, block list (starts, xis, etas, ends), digits."""
    rows = max(project_kernels.ROWS, project_gradient.ROWS) * project_kernels.BLOCK
    planes = 8 * PLANE  # T, R, alpha gradient and up to 4 colours, and room for a vector that overhangs the last
    block_list = (np.empty(MAX_BLOCKS, np.int32), np.empty(MAX_BLOCKS, np.float32), np.empty(MAX_BLOCKS, np.float32))
    ends = np.empty(256, np.int32)
    lanes = np.empty(project_kernels.BLOCK, np.int64)
    digits = np.empty(1024, np.int32)
    return np.empty(rows), lanes, aligned((planes,), np.float32), *block_list, ends, digits


def camera_entries(w2c: Tensor, K: Tensor) -> Array:
    """Return a camera as the kernels take it, [16]: R row by row, t, fx, fy, cx, cy; from [4, 4] and [3, 3]."""
    pose, k = w2c.detach().double().numpy(), K.detach().double().numpy()
    return np.concatenate([pose[:3, :3].reshape(-1), pose[:3, 3], k[[0, 1, 0, 1], [0, 1, 2, 2]]])


def chunking(channels: int) -> tuple[int, int]:
    """Return (channels per kernel pass, passes). Kernels exist for 1, 2 and 4 channels."""
    per_pass = channels if channels <= 2 else 4
    return per_pass, -(-channels // per_pass)


def pack_colors(colors: Array, depths: Array | None) -> Array:
    """Return colours [N, F] and depths [N], if any, as [chunks, N * channels] float32, padded with zeros."""
    layers = colors.shape[1] + (depths is not None)
    per_pass, passes = chunking(layers)
    if depths is None and passes == 1 and per_pass == layers and colors.dtype == np.float32:
        return np.ascontiguousarray(colors).reshape(1, -1)
    packed = np.zeros((passes, len(colors), per_pass), np.float32)
    for channel in range(colors.shape[1]):
        packed[channel // per_pass, :, channel % per_pass] = colors[:, channel]
    if depths is not None:
        packed[(layers - 1) // per_pass, :, (layers - 1) % per_pass] = depths
    return packed.reshape(passes, -1)


@dataclass(frozen=True, eq=False)
class Projection:
    """N Gaussians in one view: where they are rendered, and which tiles they touch. P: Gaussian-tile pairs."""

    camera: Array  # [16] float64, see camera_entries
    records: Array  # [N, 8] float64
    keys: Array  # [N] uint32
    depths: Array  # [N] float32
    tiles: Array  # [N, 4] int32
    slots: Array  # [N + 1] int32
    pairs: Array  # [P] uint64
    offsets: Array  # [tiles + 1] int64


def project_view(geometry: Geometry, camera: Array, s: Settings, centers: Array, radii: Array) -> Projection:
    """Project into one view and list the tiles; fills centers [N, 2] and radii [N]. Raises UserError for NaN."""
    n, threads = len(geometry.means), get_threads()
    across, down = s.tiles
    blocks = -(-n // project_kernels.BLOCK)
    records, keys, depths = aligned((n, 8), np.float64), np.empty(n, np.uint32), np.empty(n, np.float32)
    tiles, slots = np.empty((n, 4), np.int32), np.zeros(n + 1, np.int32)
    histogram, invalid = np.empty((blocks, 1 + across * down), np.int32), np.empty(blocks, np.int64)
    offsets = np.empty(across * down + 1, np.int64)
    out = Projected(records, keys, depths, centers, radii, tiles, histogram, invalid)
    announce_compilation(project_kernels.project_forward, "CPU splatting")
    scratch = [(_thread_memory(t)[0],) for t in range(threads)]
    run(project_kernels.project_forward, (geometry, s.view(camera), out), scratch)
    if n and invalid.max() >= 0:
        raise not_finite("geometry", int(invalid.max()))
    pairs = np.empty(tile_kernels.tile_offsets(histogram, offsets), np.uint64)
    run(tile_kernels.fill_tiles, (keys, tiles, across, histogram, slots, pairs), [()] * threads)
    return Projection(camera, records, keys, depths, tiles, slots, pairs, offsets)


def composite_view(p: Projection, colors: Array, channels: int, s: Settings) -> Frame:
    """Composite one view's lists, nearest first. `colors` come from `pack_colors`; `channels` in one kernel pass."""
    passes, tiles = len(colors), len(p.offsets) - 1
    order = np.zeros(len(p.pairs) + AHEAD, np.int32)
    image = np.empty((passes * channels, s.height, s.width), np.float32)
    alpha, processed = np.empty((s.height, s.width), np.float32), np.empty((passes, tiles), np.int64)
    forward, _ = raster_kernels(host_lanes(), channels)
    longest = int(np.diff(p.offsets).max())
    records = p.records.reshape(-1)
    arguments = (records, colors, p.pairs, order, p.offsets, s.width, s.height, image, alpha, processed)
    memory = [_thread_memory(t)[2:8] for t in range(get_threads())]
    run(forward, arguments, [(*m, np.empty(longest, np.uint64)) for m in memory])
    lists = (p.camera, records, p.keys, p.tiles, p.slots, order, p.offsets)
    return Frame(*lists, colors, processed, image, alpha)


def record_sums(frame: Frame, s: Settings, d_image: Array, d_alpha: Array, channels: int, count: int) -> Array:
    """Return the gradient records [passes, count, record width] of a frame's Gaussian-tile pairs."""
    sums = aligned((len(frame.colors), count * record_width(channels)), np.float32)
    _, backward = raster_kernels(host_lanes(), channels)
    lists = (frame.records, frame.colors, frame.order, frame.slots, frame.tiles, frame.offsets, frame.processed)
    images = (s.width, s.height, frame.image, frame.alpha, d_image, d_alpha)
    run(backward, (*lists, *images, sums), [_thread_memory(t)[2:7] for t in range(get_threads())])
    return sums.reshape(len(frame.colors), count, record_width(channels))


def zero_gradients(geometry: Geometry, channels: int, views: int) -> Gradients:
    """Return zeros to add the gradients of some views to; `centers` [views, N, 2] has a part for each view."""
    dtype, n = geometry.means.dtype, len(geometry.means)
    means, quats, scales, opacities = (np.zeros(a.shape, dtype) for a in geometry)
    colors, centers = np.zeros((n, channels), np.float32), np.zeros((views, n, 2), dtype)
    return Gradients(means, quats, scales, opacities, colors, centers)


def chain(
    frame: Frame | Projection, geometry: Geometry, s: Settings, sums: Array, gradients: Gradients, d_pose: Array
) -> None:
    """Chain the records to the parameters and add them to the gradients; d_pose [4, 4] is set, unless it is empty."""
    blocks = -(-len(frame.keys) // project_kernels.BLOCK) if d_pose.size else 0
    block_pose = np.empty((blocks, 12))
    records = Records(frame.keys, frame.slots, sums, gradients.colors.shape[1] if s.depth else -1)
    run(
        project_gradient.project_backward,
        (geometry, s.view(frame.camera), records, gradients, block_pose),
        [_thread_memory(t)[:2] for t in range(get_threads())],
    )
    if d_pose.size:
        d_pose[:3] = block_pose.sum(0).reshape(3, 4)


def _render_view(geometry: Geometry, colors: Array, camera: Array, s: Settings, centers: Array, radii: Array) -> Frame:
    """Render one view; fills centers [N, 2] and radii [N]."""
    projection = project_view(geometry, camera, s, centers, radii)
    packed = pack_colors(colors, projection.depths if s.depth else None)
    return composite_view(projection, packed, chunking(colors.shape[1] + s.depth)[0], s)


def _differentiate_view(
    frame: Frame, geometry: Geometry, s: Settings, d_image: Array, d_alpha: Array, gradients: Gradients, d_pose: Array
) -> None:
    """Add one view's gradients; d_pose [4, 4] is set, unless it is empty."""
    channels = chunking(gradients.colors.shape[1] + s.depth)[0]
    sums = record_sums(frame, s, d_image, d_alpha, channels, int(frame.slots[len(frame.keys)]))
    chain(frame, geometry, s, sums, gradients, d_pose)


class _Rasterize(torch.autograd.Function):
    """Tensors in, layers [C, H, W, F (+ depth)] and alpha [C, H, W] out; `probe` only receives dL/dmeans2d."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, w2c: Tensor,
        probe: Tensor, K: Tensor, settings: Settings, radii: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        geometry = Geometry(*(t.detach().contiguous().numpy() for t in (means, quats, scales, opacities)))
        frames = []
        with busy:
            for c in range(len(w2c)):
                camera = camera_entries(w2c[c], K[c])
                centers, reach = probe.detach()[c].numpy(), radii[c].numpy()
                frames.append(_render_view(geometry, colors.detach().numpy(), camera, settings, centers, reach))
        ctx.frames, ctx.geometry, ctx.settings = frames, geometry, settings
        ctx.pose_dtype, ctx.colors_dtype, ctx.channels = w2c.dtype, colors.dtype, colors.shape[1]
        layers = colors.shape[1] + settings.depth
        image = np.stack([f.image[:layers] for f in frames]) if len(frames) > 1 else frames[0].image[None, :layers]
        alpha = np.stack([f.alpha for f in frames]) if len(frames) > 1 else frames[0].alpha[None]
        return torch.from_numpy(image), torch.from_numpy(alpha)

    @staticmethod
    def backward(ctx: Any, d_image: Tensor, d_alpha: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        total = zero_gradients(ctx.geometry, ctx.channels, len(ctx.frames))
        d_w2c = np.zeros((len(ctx.frames), 4, 4) if ctx.needs_input_grad[5] else (len(ctx.frames), 0))
        with busy:
            for c, frame in enumerate(ctx.frames):
                layers = np.zeros(frame.image.shape, np.float32)
                layers[: d_image.shape[1]] = d_image[c].numpy()
                own = np.ascontiguousarray(d_alpha[c].numpy())
                gradients = total._replace(centers=total.centers[c])
                _differentiate_view(frame, ctx.geometry, ctx.settings, layers, own, gradients, d_w2c[c])
        *grads, centers = (torch.from_numpy(a) for a in total)
        grads[4] = grads[4].to(ctx.colors_dtype)
        pose = torch.from_numpy(d_w2c).to(ctx.pose_dtype) if ctx.needs_input_grad[5] else None
        return (*grads, pose, centers, None, None, None)


def render_cpu(
    splats: Splats, views: Views, *, depth: bool, antialiased: bool, near: float, eps2d: float
) -> RenderOutput:
    """Render with the back end "cpu": see `render` for the arguments."""
    if not torch.isfinite(splats.colors.detach().sum()):  # the geometry is checked while it is projected
        require_finite(splats)
    dtype = torch.float32
    if any(t.dtype == torch.float64 for t in splats.geometry):
        dtype = torch.float64
    geometry = [t.to(dtype) for t in splats.geometry]
    inputs = (*splats.geometry, splats.colors, views.w2c)
    wanted = torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
    means2d = torch.zeros(len(views), len(splats), 2, dtype=dtype, requires_grad=wanted)
    radii = torch.zeros(len(views), len(splats))
    settings = Settings(views.width, views.height, near, eps2d, antialiased, depth)
    layers, alpha = _Rasterize.apply(*geometry, splats.colors, views.w2c, means2d, views.K, settings, radii)
    layers = layers.permute(0, 2, 3, 1)
    image, far = (layers[..., :-1], layers[..., -1]) if depth else (layers, None)
    return RenderOutput(image, alpha, far, radii, means2d)
