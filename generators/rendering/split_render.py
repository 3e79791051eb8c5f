"""Key frames by `split_tracer`: soft light comes from maps, which noise does not outlive.

Soft light over the albedo is smooth on every surface and changes slowly with it. `soft` paths find it at the centres of
pixels, at anchor times. It is averaged over like surfaces around each pixel, matte light over those of all views. A
key carries each of its samples along the exact motion of its surface to the anchors before and after, and blends what
their maps have there.

Numbers of samples. A fifth of the pixels, at edges, has nearly all the noise of direct light. Pilot samples, which no
image has, tell how widely a pixel's samples spread: of the background once, of moving surfaces at anchors, from where
keys take it along the motion.

Random numbers. A key's samples near moving objects have numbers that no other key has: their noise is independent in
time. Elsewhere they have those of the background. Soft light on moving surfaces has numbers of its anchor, so its
noise travels with the surface; on static ones what counts is the difference to the background.

Streams and ground truth have the same anchor times: what carrying and blending change is the same light in both.

This module does not: smooth across edges of surfaces, smooth direct light or gloss, or reuse a sample of streams in
ground truth.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter

from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.profiles import SplitSampling
from spike4dgs.generators.rendering.like_surfaces import (
    Surfaces,
    coverage,
    join_soft,
    pixel_widths,
    places_in,
    smoothed_light,
)
from spike4dgs.generators.rendering.render import MAX_DEPTH, MultiViewRenderer, SoftStatic, StaticViews, anchor_s
from spike4dgs.generators.rendering.soft_light import SPP

_NEAR_PX = 1  # around moving objects: pixels that may see one
_MOVED = 0.1  # distance in widths of a pixel by which a point differs from the background's
_MOST_MAPS = 4
_LEAST_PATHS = 4
# First streams of keys, of maps and of pilots; those below are the background's.
_KEYS, _MAPS, _PILOTS = 1 << 20, 1 << 28, 3 << 28
_EDGE_PX = 2  # around the edge of a shadow
_LEAST_SAMPLES = 4
# Samples of a pixel go with this power of the spread. Errors of n stratified samples fall as n^-0.85: 1 / 0.85 would
# give all pixels the same noise, 2 / (1 + 2 * 0.85) = 0.74 the least noise in total.
_POWER = 0.85


class SplitRenderer(MultiViewRenderer):
    """A `MultiViewRenderer` whose pixels are the sum of direct light, gloss and soft light from maps."""

    def __init__(
        self,
        *args: Any,
        soft: SplitSampling,
        anchors_s: float | None = None,
        soft_static: SoftStatic | None = None,
        maps_of: Callable[[], SplitRenderer] | None = None,
        **others: Any,
    ) -> None:
        """Load the world; see `MultiViewRenderer`. `spp`: the most samples in a pixel.

        Args:
            soft: samples of soft light, and how many direct light has.
            anchors_s: seconds between maps, as for a rig of which these cameras are a part; if None, by their motion.
            soft_static: that of a renderer with the same arguments, where `static` is not given.
            maps_of: returns a renderer of the whole rig, whose maps these views of it take.
        """
        super().__init__(*args, **others)
        self._soft_light.spp = max(SPP, self.spp // 4)  # so that its noise stays below the rest, in ground truth too
        self.soft = soft
        self._maps: dict[float | None, Any] = {}
        self._arrays: dict[float, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        self._maps_of = maps_of
        self._spreads: dict[float, np.ndarray] = {}
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
        near, samples = self._sampling(where, t_s)
        rgb = self._rgb_at(where, samples, np.where(near, _KEYS + round(t_s * 1e7), 0), t_s)
        return rgb if self.color else gray(rgb)

    def _rgb_at(self, pixels: np.ndarray, spp: Any, stream: Any, t_s: float | None) -> np.ndarray:
        """Return linear RGB [K, 3] of flat pixels; `t_s` None: without moving objects."""
        maps, moving = self._maps_at(t_s), t_s is not None
        if t_s is not None:
            self._scene.set_time(t_s)
        rgb = self._tracer.split(pixels, spp, stream, moving, maps)
        return np.asarray(rgb * np.float32(self.world.exposure))

    # ------------------------------------------------------------ numbers of samples

    def _sampling(self, where: np.ndarray, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return which of the flat pixels [K] may see a moving object, and their samples in a key."""
        near = _around(self.object_masks(t_s), _NEAR_PX).ravel()[where]
        if self.whole_frames:
            return np.ones_like(near), np.full(len(where), self.spp)
        moving = _around(self._carried_spread(where, t_s), _NEAR_PX).ravel()[where]
        static = np.where(self._shadow_edges(t_s).ravel()[where], self.spp, self._static_samples.ravel()[where])
        return near, np.where(near, self._samples(moving), static)

    def _samples(self, spread: np.ndarray) -> np.ndarray:
        """Return the samples that the standard deviations of single ones, before exposure, ask for: powers of two."""
        wanted = (spread * self.world.exposure / self.soft.spread) ** _POWER
        return 2 ** np.ceil(np.log2(np.clip(wanted, min(_LEAST_SAMPLES, self.spp), self.spp))).astype(np.int64)

    def _shadow_edges(self, t_s: float) -> np.ndarray:
        """Return [C, H, W] bool: the pixels with both light and shadow of moving objects nearby."""
        edges = np.zeros(self.shape, bool)
        for shadow, flagged, _ in self._snapshot(t_s).shadows:
            dark = np.zeros(self.shape, bool)
            dark.ravel()[shadow.pixels[flagged]] = True
            edges |= _around(dark, _EDGE_PX) & _around(~dark, _EDGE_PX)
        return edges

    def _carried_spread(self, where: np.ndarray, t_s: float) -> np.ndarray:
        """Return [C, H, W]: what `_spread` had at the nearest anchor where moving surfaces were that are seen now.

        In and around the flat pixels `where`; elsewhere, and on static surfaces, 0. Infinite where no view had it.
        """
        anchor = round(t_s / self._anchor_s) * self._anchor_s
        known, wanted, spread = self._spread(anchor), np.zeros(self.shape, bool), np.zeros(self.shape, np.float32)
        wanted.ravel()[where] = True
        snapshot = self._snapshot(t_s)
        seen = np.flatnonzero(_around(wanted, _NEAR_PX).ravel() & snapshot.seen)
        moved = self._moved(seen, snapshot, t_s, anchor)
        view, inside = seen // known[0].size, np.zeros(len(seen), bool)
        at = np.floor(places_in(moved, self.cameras)[np.arange(len(seen)), view] + 0.5)
        inside = (at >= 0).all(1) & (at[:, 0] < self.shape[2]) & (at[:, 1] < self.shape[1])
        column, row = np.where(inside[:, None], at, 0).astype(np.int64).T
        spread.ravel()[seen] = np.where(inside, known[view, row, column], np.inf)
        return spread

    def _spread(self, t_s: float) -> np.ndarray:
        """Return the spread [C, H, W] of single samples around each pixel that may see a moving object at an anchor."""
        if t_s not in self._spreads:
            if len(self._spreads) >= _MOST_MAPS:  # times usually ascend, as of maps
                del self._spreads[min(self._spreads)]
            near, own = _around(self.object_masks(t_s), _NEAR_PX), _PILOTS + round(t_s * 1e7)
            half = (0.5, self._map(t_s))  # twice, as keys have two; one array twice is another kernel than theirs
            self._scene.set_time(t_s)
            self._spreads[t_s] = self._piloted(near, own, True, [half, half])
        return self._spreads[t_s]

    def _piloted(self, chosen: np.ndarray, stream: int, moving: bool, maps: list[tuple[float, Any]]) -> np.ndarray:
        """Return the spread [C, H, W] by pilot samples of the `chosen` pixels [C, H, W], a root mean square of 3x3."""
        where, squares = np.flatnonzero(chosen), np.zeros(self.shape, np.float32)
        squares.ravel()[where] = self._tracer.spread(where, np.full(len(where), stream), moving, maps) ** 2
        count = uniform_filter(chosen.astype(np.float32), size=(1, 3, 3), mode="constant")
        mean = uniform_filter(squares, size=(1, 3, 3), mode="constant") / np.maximum(count, 1 / 9)
        return np.sqrt(np.maximum(mean, 0))

    @cached_property
    def _static_samples(self) -> np.ndarray:
        """The samples [C, H, W] of the background."""
        if "static" in self.__dict__ and self.static.samples is not None:
            return self.static.samples.astype(np.int64)
        return self._samples(self._piloted(np.ones(self.shape, bool), _PILOTS - 1, False, self._maps_at(None)))

    @cached_property
    def static(self) -> StaticViews:
        """The views without moving objects."""
        background, samples = self.static_at(np.arange(int(np.prod(self.shape))))
        background = background.reshape(*self.shape, 3)
        return StaticViews(background, background, self.soft_static, samples.reshape(self.shape))

    def static_at(self, pixels: np.ndarray, background: bool = True) -> tuple[np.ndarray, ...]:
        """Return the background [K, 3] at flat pixels and its numbers of samples [K]; keys have the same numbers."""
        samples = self._static_samples.ravel()[pixels]
        return self._rgb_at(pixels, samples, np.zeros(len(pixels), np.int64), None), samples.astype(np.uint16)

    # ------------------------------------------------------------ soft light

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
        at, facing = (a.reshape(*self.shape, -1) for a in (points, normals))
        surfaces = Surfaces(np.zeros(self.shape, np.int8), at, facing, pixel_widths(at, self.cameras))
        paths = self._shared_paths(every, surfaces, surfaces.places(every, self.cameras))
        return points, normals, coated, paths

    def _shared_paths(self, where: np.ndarray, surfaces: Surfaces, places: np.ndarray) -> np.ndarray:
        """Return the paths [K] int32 of matte light at flat pixels: fewer where more views see the point."""
        known = np.zeros(self.shape, np.int32)
        known.ravel()[where] = 1
        views = coverage(where, known, surfaces, places)
        return np.maximum(_LEAST_PATHS, 2 ** np.ceil(np.log2(self.soft.paths / views))).astype(np.int32)

    def _paths_light(
        self, where: np.ndarray, coated: np.ndarray, paths: np.ndarray, streams: int | np.ndarray, moving: bool
    ) -> np.ndarray:
        """Return soft light [K, 6] at flat pixels, not smoothed: matte over the albedo, gloss."""
        found = np.zeros((len(where), 6), np.float32)
        found[:, :3] = self._tracer.soft(where, paths, streams, moving, gloss=False)
        own = streams if isinstance(streams, int) else streams[coated]
        found[coated, 3:] = self._tracer.soft(where[coated], self.soft.gloss_paths, own, moving, gloss=True)
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
        if not len(where):  # all that moves has left the views
            return points, normals, light
        on_object = self.object_masks(t_s).ravel()[where]
        self._scene.set_time(t_s)
        seen, facing, coated = self._tracer.surfaces(where, True)
        far = np.linalg.norm(seen - points.reshape(-1, 3)[where], axis=1)
        moved = far > _MOVED * pixel_widths(points, self.cameras).ravel()[where]
        points.reshape(-1, 3)[where[moved]], normals.reshape(-1, 3)[where[moved]] = seen[moved], facing[moved]
        labels = np.zeros(self.shape, np.int8)
        labels.ravel()[where[moved]] = 1
        surfaces = Surfaces(labels, points, normals, pixel_widths(points, self.cameras))
        places = surfaces.places(where, self.cameras)
        # static points have the paths of the background: the same random numbers, and what counts is the difference
        paths = np.zeros(self.shape, np.int32)
        paths.ravel()[where] = np.where(moved, self._shared_paths(where, surfaces, places), static.paths.ravel()[where])
        streams = np.where(on_object, _MAPS + round(t_s * 1e7), 0)
        values = np.zeros_like(light)  # in static points the change of light, elsewhere the light
        before = np.where(moved[:, None], 0, static.first.reshape(-1, 6)[where])
        values.reshape(-1, 6)[where] = self._paths_light(where, coated, paths.ravel()[where], streams, True) - before
        smooth = smoothed_light(where, values, paths, surfaces, places, self.soft.sigma_px)
        flat = light.reshape(-1, 6)
        flat[where] = np.where(moved[:, None], smooth, np.maximum(flat[where] + smooth, 0))
        return points, normals, light


def _around(images: np.ndarray, reach_px: int) -> np.ndarray:
    """Return the largest value within some pixels of each [C, H, W]."""
    return np.asarray(maximum_filter(images, size=(1, 2 * reach_px + 1, 2 * reach_px + 1)))
