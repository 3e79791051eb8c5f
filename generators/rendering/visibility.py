"""Visibility of moving objects: masks, shadows, depth, image motion. Rays only, no light.

All of it is computed at pixel centres. The rays through them, and those from the static surfaces that they meet to the
main light, never change; so they are prepared once, and at each time cast at the moving objects alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.rendering.image_motion import carried
from spike4dgs.generators.rendering.mitsuba_scene import Hits, MitsubaScene
from spike4dgs.generators.worlds import WorldScene

GROW_PX = 3  # around moving objects; more than `image_motion.COARSE_PX`
_STEP_S = 5e-6  # over which image speed is measured
_TICK_S = 5e-5  # over which, to either side, velocity is measured: what bends within a tick is below every other error
_STEEPEST = 0.05  # least sine of the angle between light and surface at which a shadow's speed is computed


class _Shadow(NamedTuple):
    """Rays from static surface points to one point of the main light that no static surface blocks."""

    pixels: np.ndarray  # [K] flat
    points: np.ndarray  # [K, 3]
    ways: np.ndarray  # [K, 3] unit, towards the light
    reach: np.ndarray  # [K] distance to the light
    rays: Any


class _Snapshot(NamedTuple):
    """The moving objects and their shadows at one time."""

    seen: np.ndarray  # [N] bool: a moving object is visible at the pixel's centre
    hits: Hits  # of all N centre rays with moving objects, hidden or not
    shadows: list[tuple[_Shadow, np.ndarray, Hits]]  # source, which of its rays [K] bool, their hits


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
        """Return bool: within 3 px of a pixel that sees a moving object or lies in the main light's shadow of one."""
        snapshot = self._snapshot(t_s)
        region = snapshot.seen.copy()
        for shadow, flagged, _ in snapshot.shadows:
            region[shadow.pixels[flagged]] = True
        return np.asarray(maximum_filter(region.reshape(self.shape), size=(1, 2 * GROW_PX + 1, 2 * GROW_PX + 1)))

    def speeds(self, t_s: float) -> np.ndarray:
        """Return float32, px/s: the speed of the fastest moving point or shadow within 3 px, exact from geometry."""
        snapshot = self._snapshot(t_s)
        speed = np.zeros(snapshot.seen.shape)
        seen = np.flatnonzero(snapshot.seen)
        speed[seen] = self._image_motion(seen, self._moved(seen, snapshot, t_s, t_s + _STEP_S))
        for shadow, flagged, hits in snapshot.shadows:
            pixels = shadow.pixels[flagged]
            motion = self._image_motion(pixels, self._moved_shadow(shadow, flagged, hits, t_s))
            speed[pixels] = np.maximum(speed[pixels], np.where(snapshot.seen[pixels], 0, motion))
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
        numbers = np.where(snapshot.seen, self._numbers(snapshot.hits), 0).astype(np.uint32)
        return self.depths(t_s), numbers.reshape(self.shape), flow.reshape(*self.shape, 2)

    # ------------------------------------------------------------ internals

    def _z(self, distance: np.ndarray) -> np.ndarray:
        """Return z in camera coordinates [C, H, W] float32 of points at a distance [N] along the centre rays."""
        forward = np.stack([c.R[2] for c in self.cameras])  # [C, 3]
        cosine = (self._rays[1].reshape(*self.shape, 3) * forward[:, None, None]).sum(-1)
        return np.asarray(distance.reshape(self.shape) * cosine, dtype=np.float32)

    def _snapshot(self, t_s: float) -> _Snapshot:
        if self._last is None or self._last[0] != t_s:
            self._scene.set_time(t_s)
            hits = self._tracer.cast_movers(self._rays[2])
            shadows = []
            for shadow in self._shadows:
                blocked = self._tracer.cast_movers(shadow.rays)
                flagged = blocked.distance < shadow.reach
                shadows.append((shadow, flagged, Hits(*(a[flagged] for a in blocked))))
            self._last = (t_s, _Snapshot(hits.distance < self._static_hits[0], hits, shadows))
        return self._last[1]

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

    @cached_property
    def _shadows(self) -> list[_Shadow]:
        origins, directions, _ = self._rays
        met = np.flatnonzero(np.isfinite(self._static_hits[0]))
        # a little short of the surface, so that it does not shadow itself
        points = origins[met] + directions[met] * (self._static_hits[0][met, None] * 0.9995)
        found = []
        for source in self.world.shadow_sources:
            ways = source[:3] - source[3] * points
            length = np.linalg.norm(ways, axis=1)
            ways /= length[:, None]
            reach = length if source[3] else np.full(len(points), np.inf)
            free = self._tracer.cast_static(self._tracer.prepare(points, ways))[0] >= 0.999 * reach
            if not free.any():  # no light falls on what is seen, and Mitsuba casts no empty list of rays
                continue
            rays = self._tracer.prepare(points[free], ways[free])
            found.append(_Shadow(met[free], points[free], ways[free], reach[free], rays))
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
        p, l_before = shadow.points[flagged], shadow.ways[flagged]
        normal = self._static_hits[1][shadow.pixels[flagged]].astype(np.float64)
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

    def _numbers(self, hits: Hits) -> np.ndarray:
        """Return the numbers, from 1, of the objects that were hit; each body of a surface is an object."""
        first = len(self.world.instances) + 1
        numbers = hits.number.astype(np.int64) + 1
        for k, surface in enumerate(self.world.deforming.values(), start=len(self.world.instances)):
            mine = hits.number == k
            bodies = np.zeros(len(surface.part.mesh.faces), np.int64) if surface.bodies is None else surface.bodies
            numbers[mine] = first + bodies[hits.face[mine]]
            first += int(bodies.max()) + 1
        return numbers
