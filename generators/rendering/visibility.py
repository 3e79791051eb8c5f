"""Visibility of moving objects: masks, shadows, depth, image motion. Rays only, no light.

All of it is computed at pixel centres. The rays through them, and those from the static surfaces that they meet to the
main light, never change; so they are prepared once, and at each time cast at the moving objects alone. So are the rays
that planar mirrors and panes of glass reflect, twice at most. Glass hides nothing: what is seen is behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.rendering.image_motion import carried, imaged, mirrored, narrow_corners, object_numbers
from spike4dgs.generators.rendering.mitsuba_scene import Hits, MitsubaScene
from spike4dgs.generators.worlds import WorldScene

GROW_PX = 3  # around moving objects; more than `image_motion.COARSE_PX`
_STEP_S = 5e-6  # over which image speed is measured
_TICK_S = 5e-5  # over which, to either side, velocity is measured: what bends within a tick is below every other error
_STEEPEST = 0.05  # least sine of the angle between light and surface at which a shadow's speed is computed


_MOST_REFLECTIONS = 2  # one after another; the renderer's paths show no more of direct light


class _Sight(NamedTuple):
    """Rays through pixel centres, or their reflections, and the static surface points that they meet."""

    pixels: np.ndarray  # [K] flat, ascending
    origins: np.ndarray  # [K, 3]
    ways: np.ndarray  # [K, 3] unit
    rays: Any
    reach: np.ndarray  # [K] distance to the static surface; inf: none
    normals: np.ndarray  # [K, 3] of it
    planes: tuple[np.ndarray, ...] = ()  # [K, 4] each: of the mirrors and panes that reflected a ray
    in_glass: bool = False  # one of them is glass


class _Shadow(NamedTuple):
    """Rays from static surface points to one point of the main light that no static surface blocks."""

    pixels: np.ndarray  # [K] flat
    points: np.ndarray  # [K, 3]
    normals: np.ndarray  # [K, 3]
    ways: np.ndarray  # [K, 3] unit, towards the light
    reach: np.ndarray  # [K] distance to the light
    rays: Any
    planes: tuple[np.ndarray, ...]  # as of a `_Sight`


class _Snapshot(NamedTuple):
    """The moving objects and their shadows at one time."""

    seen: np.ndarray  # [N] bool: a moving object is visible at the pixel's centre
    hits: Hits  # of all N centre rays with moving objects, hidden or not
    shadows: list[tuple[_Shadow, np.ndarray, Hits]]  # source, which of its rays [K] bool, their hits
    reflections: list[tuple[_Sight, np.ndarray, Hits]]  # of moving objects: sight, which of its rays [K] bool, hits


class Visibility:
    """Geometry of all `cameras` (one resolution) at any time; arrays are [C, H, W]."""

    _tracer: Any  # set by the subclass

    def __init__(self, world: WorldScene, cameras: Sequence[Camera], scene: MitsubaScene) -> None:
        self.world, self.cameras = world, tuple(cameras)
        self.shape = (len(cameras), cameras[0].height, cameras[0].width)
        self._scene = scene
        self._last: tuple[float, _Snapshot] | None = None

    def object_masks(self, t_s: float) -> np.ndarray:
        """Return bool: the ray through the pixel's centre meets a moving object first."""
        return self._snapshot(t_s).seen.reshape(self.shape)

    def moving_masks(self, t_s: float) -> np.ndarray:
        """Return bool: the same, or the ray through the pixel's centre meets a mirror that shows a moving object."""
        mask = self.object_masks(t_s).copy()
        for sight, flagged, _ in self._snapshot(t_s).reflections:
            if not sight.in_glass:
                mask.ravel()[sight.pixels[flagged]] = True
        return mask

    def depths(self, t_s: float) -> np.ndarray:
        """Return float32: z in camera coordinates where the ray through the pixel's centre ends (inf: no surface)."""
        snapshot = self._snapshot(t_s)
        return self._z(np.where(snapshot.seen, snapshot.hits.distance, self._static_hits[0]))

    def static_depths(self) -> np.ndarray:
        """Return the same without moving objects."""
        return self._z(self._static_hits[0])

    def velocities(self, t_s: float) -> np.ndarray:
        """Return [C, H, W, 3] float32, m/s: the velocity of the surface point that is seen; 0 where that is static."""
        snapshot, out = self._snapshot(t_s), np.zeros((int(np.prod(self.shape)), 3), np.float32)
        seen = np.flatnonzero(snapshot.seen)
        before, after = (self._moved(seen, snapshot, t_s, t_s + step) for step in (-_TICK_S, _TICK_S))
        out[seen] = (after - before) / (2 * _TICK_S)
        return out.reshape(*self.shape, 3)

    def traced(self, t_s: float) -> np.ndarray:
        """Return bool: within 3 px of a pixel that sees, directly or reflected, a moving object or its shadow.

        Bodies so narrow that rays through pixel centres may miss them are seen where their corners are.
        """
        snapshot = self._snapshot(t_s)
        region = snapshot.seen.copy()
        region[self._narrow(t_s)[0]] = True
        for sight, flagged, _ in snapshot.reflections:
            region[sight.pixels[flagged]] = True
        for shadow, flagged, _ in snapshot.shadows:
            region[shadow.pixels[flagged]] = True
        return np.asarray(maximum_filter(region.reshape(self.shape), size=(1, 2 * GROW_PX + 1, 2 * GROW_PX + 1)))

    def speeds(self, t_s: float) -> np.ndarray:
        """Return float32, px/s: the speed of the fastest moving point or shadow within 3 px, exact from geometry.

        Those in mirrors and panes move as their mirror images do.
        """
        snapshot = self._snapshot(t_s)
        speed = np.zeros(snapshot.seen.shape)
        seen = np.flatnonzero(snapshot.seen)
        speed[seen] = self._image_motion(seen, self._moved(seen, snapshot, t_s, t_s + _STEP_S))
        np.maximum.at(speed, *self._narrow(t_s))
        for shadow, flagged, hits in snapshot.shadows:
            pixels = shadow.pixels[flagged]
            moved = imaged(self._moved_shadow(shadow, flagged, hits, t_s), [p[flagged] for p in shadow.planes])
            motion = self._image_motion(pixels, moved)
            speed[pixels] = np.maximum(speed[pixels], np.where(snapshot.seen[pixels], 0, motion))
        for sight, flagged, hits in snapshot.reflections:
            met = sight.origins[flagged] + sight.ways[flagged] * hits.distance[:, None]
            moved = carried(self.world, hits, met, t_s, t_s + _STEP_S)
            moved = imaged(moved, [p[flagged] for p in sight.planes])
            pixels = sight.pixels[flagged]
            speed[pixels] = np.maximum(speed[pixels], self._image_motion(pixels, moved))
        grown = maximum_filter(speed.reshape(self.shape), size=(1, 2 * GROW_PX + 1, 2 * GROW_PX + 1))
        return np.asarray(grown / _STEP_S, dtype=np.float32)

    def geometry(self, t_s: float, dt_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return depth [C, H, W] float32, object numbers [C, H, W] uint32 and optical flow [C, H, W, 2] float32 in px.

        Number 0 is static; k is `world.object_names[k - 1]`. Flow is the motion of the pixel's surface point from `t_s`
        to `t_s + dt_s`, whether or not the point is visible then.
        """
        snapshot = self._snapshot(t_s)
        seen = np.flatnonzero(snapshot.seen)
        flow = np.zeros((len(snapshot.seen), 2), np.float32)
        moved = self._moved(seen, snapshot, t_s, t_s + dt_s)
        for view, camera, mine in self._by_view(seen):
            uv, _ = camera.project(moved[mine])
            flow[seen[mine]] = uv - self._centres(seen[mine], view)
        numbers = np.where(snapshot.seen, object_numbers(self.world, snapshot.hits), 0).astype(np.uint32)
        return self.depths(t_s), numbers.reshape(self.shape), flow.reshape(*self.shape, 2)

    # ------------------------------------------------------------ internals

    def _narrow(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels [K] with corners of narrow bodies before static surfaces, and their motion in a moment, px."""
        pixels, distance, motion = narrow_corners(self.world, self.cameras, t_s, t_s + _STEP_S)
        near = distance < self._static_hits[0][pixels]
        return pixels[near], motion[near]

    def _z(self, distance: np.ndarray) -> np.ndarray:
        """Return z in camera coordinates [C, H, W] float32 of points at a distance [N] along the centre rays."""
        forward = np.stack([c.R[2] for c in self.cameras])  # [C, 3]
        cosine = (self._rays[1].reshape(*self.shape, 3) * forward[:, None, None]).sum(-1)
        return np.asarray(distance.reshape(self.shape) * cosine, dtype=np.float32)

    def _snapshot(self, t_s: float) -> _Snapshot:
        if self._last is None or self._last[0] != t_s:
            self._scene.set_time(t_s)
            hits = self._tracer.cast_movers(self._rays[2])
            shadows, reflections = ([self._met(x) for x in some] for some in (self._shadows, self._reflections))
            self._last = (t_s, _Snapshot(hits.distance < self._static_hits[0], hits, shadows, reflections))
        return self._last[1]

    def _met(self, lines: Any) -> tuple[Any, np.ndarray, Hits]:
        """Return a shadow or a sight, which of its rays [K] moving objects cross within their reach, and these hits."""
        hits = self._tracer.cast_movers(lines.rays)
        flagged = hits.distance < lines.reach
        return lines, flagged, Hits(*(a[flagged] for a in hits))

    @cached_property
    def _rays(self) -> tuple[np.ndarray, np.ndarray, Any]:
        """Return origins and unit directions [N, 3] float64 through the pixel centres, and the same, prepared."""
        _, height, width = self.shape
        v, u = np.mgrid[:height, :width] + 0.5
        uv = np.stack([u.ravel(), v.ravel()], 1)
        directions = np.concatenate([c.unproject(uv, np.ones(len(uv))) - c.center for c in self.cameras])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        origins = np.repeat(np.stack([c.center for c in self.cameras]), len(uv), axis=0)
        return origins, directions, self._tracer.prepare(origins, directions)

    @cached_property
    def _static_hits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return distance [N] and normal [N, 3] of the static surfaces."""
        return self._tracer.cast_static(self._rays[2])  # type: ignore[no-any-return]

    @property
    def _direct(self) -> _Sight:
        return _Sight(np.arange(len(self._rays[0])), *self._rays, *self._static_hits)

    @cached_property
    def _reflections(self) -> list[_Sight]:
        """Reflections of the centre rays; a moving object may hide the mirror."""
        found, last = [], [self._direct]
        for _ in range(_MOST_REFLECTIONS):
            last = [reflected for sight in last for reflected in self._reflected(sight)]
            found += last
        return found

    def _reflected(self, sight: _Sight) -> list[_Sight]:
        """Return what mirrors and panes reflect of rays."""
        found = []
        for number, scene in enumerate(self._scene.reflectors):
            if scene is None:
                continue
            distance, normals = (a.astype(np.float64) for a in self._tracer.cast_static(sight.rays, scene))
            at = np.flatnonzero(np.isfinite(distance) & (distance <= sight.reach * (1 + 1e-5)))
            if not len(at):  # Mitsuba casts no empty list of rays
                continue
            points = sight.origins[at] + sight.ways[at] * distance[at, None]
            planes = np.concatenate([normals[at], (normals[at] * points).sum(1, keepdims=True)], axis=1)
            ways = mirrored(sight.ways[at], planes * [1, 1, 1, 0])
            origins = points + 1e-5 * ways  # so that they leave the mirror
            rays = self._tracer.prepare(origins, ways)
            passed = *(plane[at] for plane in sight.planes), planes
            reach, facing = self._tracer.cast_static(rays)
            own = sight.pixels[at], origins, ways, rays, reach, facing, passed
            found.append(_Sight(*own, sight.in_glass or number == 1))
        return found

    @cached_property
    def _shadows(self) -> list[_Shadow]:
        return [shadow for sight in (self._direct, *self._reflections) for shadow in self._shadows_in(sight)]

    def _shadows_in(self, sight: _Sight) -> list[_Shadow]:
        met = np.flatnonzero(np.isfinite(sight.reach))
        # a little short of the surface, so that it does not shadow itself
        points = sight.origins[met] + sight.ways[met] * (sight.reach[met, None] * 0.9995)
        found = []
        for source in self.world.shadow_sources if len(met) else ():  # Mitsuba casts no empty list of rays
            ways = source[:3] - source[3] * points
            length = np.linalg.norm(ways, axis=1)
            ways /= length[:, None]
            reach = length if source[3] else np.full(len(points), np.inf)
            free = self._tracer.cast_static(self._tracer.prepare(points, ways))[0] >= 0.999 * reach
            if not free.any():  # no light falls on what is seen
                continue
            rays = self._tracer.prepare(points[free], ways[free])
            at = met[free]
            planes = tuple(plane[at] for plane in sight.planes)
            lit = sight.pixels[at], points[free], sight.normals[at].astype(np.float64)
            found.append(_Shadow(*lit, ways[free], reach[free], rays, planes))
        return found

    def _moved(self, pixels: np.ndarray, snapshot: _Snapshot, from_s: float, to_s: float) -> np.ndarray:
        """Return the positions [K, 3] at `to_s` of the moving points that `pixels` see at `from_s`."""
        origins, directions, _ = self._rays
        hits = Hits(*(a[pixels] for a in snapshot.hits))
        return carried(self.world, hits, origins[pixels] + directions[pixels] * hits.distance[:, None], from_s, to_s)

    def _moved_shadow(self, shadow: _Shadow, flagged: np.ndarray, hits: Hits, t_s: float) -> np.ndarray:
        """Return the positions [K, 3] a moment later of the shadows of the points that block the rays `flagged`.

        The surface around the shadowed point is taken as plane. With S = (way to the light, w) homogeneous, the line
        from the moved blocker q along the light meets it at q - s l, where s = (q - p).n / l.n.
        """
        p, l_before, normal = shadow.points[flagged], shadow.ways[flagged], shadow.normals[flagged]
        reach = shadow.reach[flagged]
        q = carried(self.world, hits, p + l_before * hits.distance[:, None], t_s, t_s + _STEP_S)
        far = np.isinf(reach)
        light = p + l_before * np.where(far, 0, reach)[:, None]
        ways = np.where(far[:, None], l_before, light - q)
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        incline = (ways * normal).sum(1)
        incline = np.where(np.abs(incline) < _STEEPEST, np.copysign(_STEEPEST, incline), incline)
        return np.asarray(q - ways * (((q - p) * normal).sum(1) / incline)[:, None])

    def _image_motion(self, pixels: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Return the distance [K] in px between the pixels' centres and the projected points `moved` [K, 3]."""
        out = np.zeros(len(pixels))
        for view, camera, mine in self._by_view(pixels):
            uv, _ = camera.project(moved[mine])
            out[mine] = np.linalg.norm(uv - self._centres(pixels[mine], view), axis=1)
        return out

    def _by_view(self, pixels: np.ndarray) -> list[tuple[int, Camera, slice]]:
        """Return the views and their ranges in the ascending flat numbers `pixels`."""
        area = self.shape[1] * self.shape[2]
        bounds = np.searchsorted(pixels, np.arange(self.shape[0] + 1) * area)
        return [(v, c, slice(bounds[v], bounds[v + 1])) for v, c in enumerate(self.cameras)]

    def _centres(self, pixels: np.ndarray, view: int) -> np.ndarray:
        row, column = np.divmod(pixels - view * self.shape[1] * self.shape[2], self.shape[2])
        return np.stack([column + 0.5, row + 0.5], axis=1)
