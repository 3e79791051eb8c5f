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

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.profiles import SoftSampling
from spike4dgs.generators.rendering.like_surfaces import coverage, pixel_widths, places_in, shared, smoothed
from spike4dgs.generators.rendering.render import MAX_DEPTH, MultiViewRenderer, SoftStatic, StaticViews, anchor_s

_NEAR_PX = 1  # around moving objects: pixels that may see one
_MOVED = 0.1  # distance in widths of a pixel by which a point differs from the background's
_MOST_MAPS = 4
_LEAST_PATHS = 4
_KEYS, _MAPS = 1 << 20, 1 << 28  # first of the streams of keys and of maps; those below are the background's


class SplitRenderer(MultiViewRenderer):
    """A `MultiViewRenderer` whose pixels are the sum of direct light, gloss and soft light from maps."""

    def __init__(
        self,
        *args: Any,
        soft: SoftSampling,
        anchors_s: float | None = None,
        soft_static: SoftStatic | None = None,
        maps_of: Callable[[], SplitRenderer] | None = None,
        **others: Any,
    ) -> None:
        """Load the world; see `MultiViewRenderer`. `spp` and `background_spp` are the samples of direct light.

        Args:
            soft: samples of soft light.
            anchors_s: seconds between maps, as for a rig of which these cameras are a part; if None, by their motion.
            soft_static: that of a renderer with the same arguments, where `static` is not given.
            maps_of: returns a renderer of the whole rig, whose maps these views of it take.
        """
        super().__init__(*args, **others)
        self.soft = soft
        self._maps: dict[float | None, Any] = {}
        self._arrays: dict[float, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        self._maps_of = maps_of
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
        """Return of the background at flat pixels what `SoftStatic` has, but for `smooth`."""
        points, normals, coated, paths = (a[pixels] for a in self._static_surfaces)
        return points, normals, paths, self._paths_light(pixels, coated, paths, 0, False)

    @cached_property
    def _static_surfaces(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points and normals [N, 3] of the background in all pixels, which have a coat, and their numbers of paths."""
        every = np.arange(int(np.prod(self.shape)))
        points, normals, coated = self._tracer.surfaces(every, False)
        geometry = (a.reshape(*self.shape, -1) for a in (points, normals))
        alike = np.zeros(self.shape, np.int8)
        return points, normals, coated, self._shared_paths(every, alike, *geometry)

    def _shared_paths(
        self, where: np.ndarray, labels: np.ndarray, points: np.ndarray, normals: np.ndarray
    ) -> np.ndarray:
        """Return the paths [K] int32 of matte light at flat pixels: fewer where more views see the point."""
        known = np.zeros(self.shape, np.int32)
        known.ravel()[where] = 1
        places = places_in(points.reshape(-1, 3)[where], self.cameras)
        views = coverage(where, known, labels, points, normals, pixel_widths(points, self.cameras), places)
        return np.maximum(_LEAST_PATHS, 2 ** np.ceil(np.log2(self.soft.spp / views)).astype(np.int32)).astype(np.int32)

    def _paths_light(
        self, where: np.ndarray, coated: np.ndarray, paths: np.ndarray, streams: int | np.ndarray, moving: bool
    ) -> np.ndarray:
        """Return soft light [K, 6] at flat pixels, not smoothed: matte over the albedo, gloss."""
        found = np.zeros((len(where), 6), np.float32)
        found[:, :3] = self._tracer.soft(where, paths, streams, moving, gloss=False)
        own = streams if isinstance(streams, int) else streams[coated]
        found[coated, 3:] = self._tracer.soft(where[coated], self.soft.gloss_spp, own, moving, gloss=True)
        return found

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

        of = self._maps_of() if self._maps_of else self
        numbers = {camera.id: k for k, camera in enumerate(of.cameras)}
        mine = [numbers[camera.id] for camera in self.cameras]
        points, normals, light = (a[mine].reshape(-1, a.shape[-1]) for a in of.soft_arrays(t_s))
        corners = self._scene.moving_vertices(0.0 if t_s is None else t_s)
        return soft_map(SoftPoints(points, normals, light[:, :3], light[:, 3:]), corners)

    def soft_arrays(self, t_s: float | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return points, normals [C, H, W, 3] and smoothed soft light [C, H, W, 6]; `t_s` None: without objects."""
        if t_s is None:
            return self.soft_static.points, self.soft_static.normals, self.soft_static.smooth
        if t_s not in self._arrays:
            if len(self._arrays) >= _MOST_MAPS:  # times usually ascend; dropped arrays can be made again, equal
                del self._arrays[min(self._arrays)]
            self._arrays[t_s] = self._make_arrays(t_s)
        return self._arrays[t_s]

    def _make_arrays(self, t_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        static = self.soft_static
        points, normals, light = (np.array(a) for a in (static.points, static.normals, static.smooth))
        reach = 2 * (int(np.ceil(self.soft.anchor_px)) + 1) + 1  # what the keys between two anchors trace
        where = np.flatnonzero(maximum_filter(self.traced(t_s), size=(1, reach, reach)))
        on_object = self.object_masks(t_s).ravel()[where]
        self._scene.set_time(t_s)
        seen, facing, coated = self._tracer.surfaces(where, True)
        far = np.linalg.norm(seen - points.reshape(-1, 3)[where], axis=1)
        moved = far > _MOVED * pixel_widths(points, self.cameras).ravel()[where]
        points.reshape(-1, 3)[where[moved]], normals.reshape(-1, 3)[where[moved]] = seen[moved], facing[moved]
        labels = np.zeros(self.shape, np.int8)
        labels.ravel()[where[moved]] = 1
        # static points have the paths of the background: the same random numbers, and what counts is the difference
        paths = np.zeros(self.shape, np.int32)
        paths.ravel()[where] = np.where(
            moved, self._shared_paths(where, labels, points, normals), static.paths.ravel()[where]
        )
        streams = np.where(on_object, _MAPS + round(t_s * 1e7), 0)
        values = np.zeros_like(light)  # in static points the change of light, elsewhere the light
        before = np.where(moved[:, None], 0, static.first.reshape(-1, 6)[where])
        values.reshape(-1, 6)[where] = self._paths_light(where, coated, paths.ravel()[where], streams, True) - before
        smooth = smoothed_light(where, values, paths, labels, points, normals, self.cameras, self.soft.sigma_px)
        flat = light.reshape(-1, 6)
        flat[where] = np.where(moved[:, None], smooth, np.maximum(flat[where] + smooth, 0))
        return points, normals, light


def join_soft(parts: Sequence[tuple[np.ndarray, ...]], cameras: Sequence[Camera], sigma_px: float) -> SoftStatic:
    """Return the background's map of the results of `SplitRenderer.soft_at` for all pixels in order."""
    shape = len(cameras), cameras[0].height, cameras[0].width
    points, normals, paths, first = (np.concatenate(p).reshape(*shape, -1) for p in zip(*parts, strict=True))
    paths, labels = paths[..., 0], np.zeros(shape, np.int8)
    smooth = smoothed_light(np.arange(labels.size), first, paths, labels, points, normals, cameras, sigma_px)
    return SoftStatic(points, normals, paths, first, smooth.reshape(first.shape))


def smoothed_light(
    where: np.ndarray,
    light: np.ndarray,
    paths: np.ndarray,
    labels: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    cameras: Sequence[Camera],
    sigma_px: float,
) -> np.ndarray:
    """Return soft light [K, 6] at flat pixels: matte light is a mean over all views, gloss over one."""
    widths = pixel_widths(points, cameras)
    matte, gloss = (np.ascontiguousarray(light[..., part]) for part in (slice(3), slice(3, 6)))
    places = places_in(points.reshape(-1, 3)[where], cameras)
    return np.concatenate(
        [
            shared(where, matte, paths, labels, points, normals, widths, places, sigma_px),
            smoothed(where, gloss, labels, points, normals, widths, sigma_px),
        ],
        1,
    )
