"""Key frames by `split_tracer`: soft light comes from maps, which noise does not outlive.

Soft light over the albedo is smooth on every surface and changes slowly with it. `soft` paths find it at the centres of
pixels, at anchor times, and it is averaged over like surfaces around each pixel. A
key carries each of its samples along the exact motion of its surface to the anchors before and after, and blends what
their maps have there.

Random numbers. A key's samples near moving objects have numbers that no other key has: their noise is independent in
time. Elsewhere they have the same numbers at all times, and what counts is the difference that they see to the
background. Soft light on moving surfaces has numbers of its anchor, so its noise travels with the surface.

Streams and ground truth have the same anchor times: what carrying and blending change is the same light in both.

This module does not: smooth across edges of surfaces, smooth direct light or gloss, or reuse a sample of streams in
ground truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.profiles import SoftSampling
from spike4dgs.generators.rendering.like_surfaces import smoothed
from spike4dgs.generators.rendering.render import MAX_DEPTH, MultiViewRenderer, SoftStatic, StaticViews, anchor_s

_NEAR_PX = 1  # around moving objects: pixels that may see one
_MOVED = 0.1  # distance in widths of a pixel by which a point differs from the background's
_MOST_MAPS = 4
_KEYS, _MAPS = 1 << 20, 1 << 28  # first of the streams of keys and of maps; those below are the background's


class SplitRenderer(MultiViewRenderer):
    """A `MultiViewRenderer` whose pixels are the sum of direct light, gloss and soft light from maps."""

    def __init__(
        self,
        *args: Any,
        soft: SoftSampling,
        anchors_s: float | None = None,
        soft_static: SoftStatic | None = None,
        **others: Any,
    ) -> None:
        """Load the world; see `MultiViewRenderer`. `spp` and `background_spp` are the samples of direct light.

        Args:
            soft: samples of soft light.
            anchors_s: seconds between maps, as for a rig of which these cameras are a part; if None, by their motion.
            soft_static: that of a renderer with the same arguments, where `static` is not given.
        """
        super().__init__(*args, **others)
        self.soft = soft
        self._maps: dict[float | None, Any] = {}
        known = others.get("static")
        if (given := soft_static if known is None else known.soft) is not None:
            self.soft_static = given
        self._anchor_s = anchors_s or anchor_s(self.world, self.cameras, soft.anchor_px)

    def _make_tracer(self, seed: int, psf_px: float) -> Any:
        from spike4dgs.generators.rendering.split_tracer import SplitTracer

        return SplitTracer(self._scene, self.cameras, seed, MAX_DEPTH, psf_px)

    # ------------------------------------------------------------ images

    def _traced_at(self, where: np.ndarray, t_s: float) -> np.ndarray:
        """Return the radiance [K] or [K, 3] of the flat pixels `where` of a key."""
        own = _KEYS + round(t_s * 1e7)
        near = maximum_filter(self.object_masks(t_s), size=(1, 2 * _NEAR_PX + 1, 2 * _NEAR_PX + 1)).ravel()[where]
        near |= self.whole_frames
        rgb = self._rgb_at(where, self.spp, np.where(near, own, 0), t_s)
        traced = rgb if self.color else gray(rgb)
        background, first = (self._flat(image)[where] for image in (self.background, self._first))
        seen = near[:, None] if self.color else near
        return np.asarray(np.where(seen, traced, np.maximum(traced + (background - first), 0)))

    def _rgb_at(self, pixels: np.ndarray, spp: int, stream: Any, t_s: float | None) -> np.ndarray:
        """Return linear RGB [K, 3] of flat pixels; `t_s` None: without moving objects."""
        maps, moving = self._maps_at(t_s), t_s is not None
        if t_s is not None:
            self._scene.set_time(t_s)
        rgb = self._tracer.split(pixels, spp, stream, moving, maps)
        return np.asarray(rgb * np.float32(self.world.exposure))

    # ------------------------------------------------------------ soft light

    @cached_property
    def static(self) -> StaticViews:
        """The views without moving objects."""
        views = super().static
        return StaticViews(views.background, views.first, self.soft_static)

    @cached_property
    def soft_static(self) -> SoftStatic:
        """The map of the background."""
        return join_soft([self.soft_at(np.arange(int(np.prod(self.shape))))], self.cameras, self.soft.sigma_px)

    def soft_at(self, pixels: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return points and normals [K, 3] of the background at flat pixels, and soft light [K, 6], not smoothed."""
        known = self._tracer.soft(pixels, self.soft.spp, self.soft.gloss_spp, 0, False)
        return known.points, known.normals, np.concatenate([known.matte, known.gloss], 1)

    def _maps_at(self, t_s: float | None) -> list[tuple[float, Any]]:
        """Return the maps to blend at a time, and their weights."""
        if t_s is None:
            return [(1.0, self._map(None))]
        first = int(np.floor(t_s / self._anchor_s))
        late = float(np.clip(t_s / self._anchor_s - first, 0.01, 0.99))  # what one anchor hides is in the other's map
        return [(1 - late, self._map(first * self._anchor_s)), (late, self._map((first + 1) * self._anchor_s))]

    def _map(self, t_s: float | None) -> Any:
        if t_s not in self._maps:
            if len(self._maps) >= _MOST_MAPS:  # times usually ascend; a dropped map can be made again, equal
                del self._maps[min((t for t in self._maps if t is not None), default=None)]
            self._maps[t_s] = self._make_map(t_s)
        return self._maps[t_s]

    def _make_map(self, t_s: float | None) -> Any:
        """Return the map at a time; None: of the background."""
        from spike4dgs.generators.rendering.soft_map import SoftPoints, soft_map

        static = self.soft_static
        points, normals, light = (np.array(a) for a in (static.points, static.normals, static.smooth))
        if t_s is not None:
            where, known, moved = self._soft_points(t_s)
            flat = [a.reshape(-1, a.shape[-1]) for a in (points, normals, light)]
            flat[0][where[moved]], flat[1][where[moved]] = known.points[moved], known.normals[moved]
            values = np.zeros_like(light)  # in static points the change of light, elsewhere the light
            before = np.where(moved[:, None], 0, static.first.reshape(-1, 6)[where])
            values.reshape(-1, 6)[where] = np.concatenate([known.matte, known.gloss], 1) - before
            labels = np.zeros(self.shape, np.int8)
            labels.ravel()[where[moved]] = 1
            widths = pixel_widths(points, self.cameras)
            smooth = smoothed(where, values, labels, points, normals, widths, self.soft.sigma_px)
            flat[2][where] = np.where(moved[:, None], smooth, np.maximum(flat[2][where] + smooth, 0))
        corners = self._scene.moving_vertices(0.0 if t_s is None else t_s)
        known = SoftPoints(*(a.reshape(-1, 3) for a in (points, normals, light[..., :3], light[..., 3:])))
        return soft_map(known, corners)

    def _soft_points(self, t_s: float) -> tuple[np.ndarray, Any, np.ndarray]:
        """Return the flat pixels [K] whose soft light may differ from the background's, it, and which points moved."""
        reach = 2 * (int(np.ceil(self.soft.anchor_px)) + 1) + 1  # what the keys between two anchors trace
        where = np.flatnonzero(maximum_filter(self.traced(t_s), size=(1, reach, reach)))
        own = _MAPS + round(t_s * 1e7)
        streams = np.where(self.object_masks(t_s).ravel()[where], own, 0)
        self._scene.set_time(t_s)
        known = self._tracer.soft(where, self.soft.spp, self.soft.gloss_spp, streams, True)
        far = np.linalg.norm(known.points - self.soft_static.points.reshape(-1, 3)[where], axis=1)
        return where, known, far > _MOVED * pixel_widths(self.soft_static.points, self.cameras).ravel()[where]


def join_soft(parts: Sequence[tuple[np.ndarray, ...]], cameras: Sequence[Camera], sigma_px: float) -> SoftStatic:
    """Return the background's map of the results of `SplitRenderer.soft_at` for all pixels in order."""
    shape = len(cameras), cameras[0].height, cameras[0].width
    points, normals, first = (np.concatenate(p).reshape(*shape, -1) for p in zip(*parts, strict=True))
    labels, widths = np.zeros(shape, np.int8), pixel_widths(points, cameras)
    smooth = smoothed(np.arange(labels.size), first, labels, points, normals, widths, sigma_px)
    return SoftStatic(points, normals, first, smooth.reshape(first.shape))


def pixel_widths(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the width [C, H, W] float32 in metres of a pixel at surface points [C, H, W, 3]."""
    depths = [np.abs(p @ c.R[2] + c.t[2]) / c.fx for p, c in zip(points, cameras, strict=True)]
    return np.stack(depths).astype(np.float32)
