"""Key frames of a world: the background once, and at each time only the pixels that the moving things change.

Three kinds of pixel, cheapest first:

- *Still*: the background, rendered once with many samples.
- *Softly lit* (bounced light, wide penumbrae): the background times a slowly varying factor, see `soft_light`.
- *Traced* at every key: a ray through the pixel's centre meets a moving instance, or the surface that it meets has one
  between itself and the light; both grown by 3 px.

Common random numbers: a pixel's samples depend on (seed, camera, pixel, number of samples) only. What stands still
keeps its noise from key to key, and a list of pixels traced alone equals the same pixels of the whole picture, bit for
bit. Traced pixels that see no moving surface, only its shadow, get the background plus the *difference* of two such
renderings: the background's low noise stays, and nothing jumps where the traced region ends.

This module does not: blur motion (a key is an instant), filter (a pixel is the box mean of its area), or denoise.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter

from spike4dgs.benchmark.cameras import Camera
from spike4dgs.benchmark.errors import problem
from spike4dgs.generators.mitsuba_scene import MitsubaScene
from spike4dgs.generators.mitsuba_variant import load_mitsuba
from spike4dgs.generators.motion import max_image_speed
from spike4dgs.generators.soft_light import MOTION_PX, SoftLight
from spike4dgs.generators.worlds import WorldScene

MAX_DEPTH = 4  # camera, surface, two bounces
_GROW_PX = 3


class MultiViewRenderer:
    """Renders all `cameras` (one resolution) of a world together: one launch per time. Pictures are [C, H, W] float32.

    >>> renderer = MultiViewRenderer(world, cameras(world, 200, 125), seed=0, spp=64, background_spp=256)
    >>> pictures = [renderer.keys(t_s) for t_s in np.arange(0, 0.02, 0.0005)]
    """

    def __init__(
        self, world: WorldScene, cameras: Sequence[Camera], *, seed: int, spp: int, background_spp: int
    ) -> None:
        """Loads the world into Mitsuba (about a second).

        `spp` and `background_spp` are powers of two, the background's at least `spp`. Raises UserError otherwise.
        """
        for name, value in (("spp", spp), ("background_spp", background_spp)):
            if value < 1 or value & (value - 1):
                raise problem(name, "a power of two", str(value), "give 16, 32, 64, ...")
        if background_spp < spp:
            raise problem("background_spp", f"at least spp = {spp}", str(background_spp), "raise it")
        if len({(c.width, c.height) for c in cameras}) != 1:
            raise problem("cameras", "one resolution for all", "several or none", "render them apart")
        self.world, self.cameras, self.spp, self.background_spp = world, tuple(cameras), spp, background_spp
        self.shape = (len(cameras), cameras[0].height, cameras[0].width)
        self._scene = MitsubaScene(world)
        self._tracer = _tracer(self._scene, self.cameras, seed)
        self._seed = seed
        self._soft_light = SoftLight(self.shape, self._trace_at, self.traced, self._anchor_s())
        self._last_hits: tuple[float, np.ndarray, np.ndarray] | None = None

    # ------------------------------------------------------------ pictures

    def backgrounds(self) -> np.ndarray:
        """The views without the moving instances."""
        return self._backgrounds[0]

    def keys(self, t_s: float) -> np.ndarray:
        """The views at `t_s`: still, softly lit and traced pixels put together."""
        background, same_numbers = self._backgrounds
        picture = background * (1 + self._soft_light.change(t_s))
        where = np.flatnonzero(self.traced(t_s))
        traced = self._trace_at(where, self.spp, True, t_s) * np.float32(self.world.exposure)
        correction = background.ravel()[where] - same_numbers.ravel()[where]
        correction[self.object_masks(t_s).ravel()[where]] = 0
        picture.ravel()[where] = np.maximum(traced + correction, 0)
        return picture

    def crn_frames(self, t_s: float) -> np.ndarray:
        """Every pixel traced at `t_s` with the random numbers of `keys`; for measuring what `keys` leaves out."""
        self._scene.place(t_s)
        return self._whole(self.spp, 0, True)

    def reference_frames(self, t_s: float, spp: int) -> np.ndarray:
        """The views at `t_s` by Mitsuba's own render loop, sensor, film and sampler: every pixel, nothing reused."""
        mi = load_mitsuba()
        from spike4dgs.generators.scalar_tiles import load_sensor

        self._scene.place(t_s)
        integrator = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH})
        frames = []
        for camera in self.cameras:
            sensor = load_sensor(camera, {"type": "hdrfilm", "width": camera.width, "height": camera.height}, spp)
            rgb = np.array(mi.render(self._scene.full, sensor=sensor, integrator=integrator, seed=self._seed + 1))
            frames.append(rgb[..., :3] @ np.array([0.212671, 0.715160, 0.072169], np.float32))
        return np.stack(frames) * np.float32(self.world.exposure)

    # ------------------------------------------------------------ geometry

    def object_masks(self, t_s: float) -> np.ndarray:
        """[C, H, W] bool: the ray through the pixel's centre meets a moving instance first."""
        return self._hits(t_s)[1].reshape(self.shape)

    def depths(self, t_s: float) -> np.ndarray:
        """[C, H, W] float32: z in camera coordinates where the ray through the pixel's centre ends (inf: nothing)."""
        distance = self._hits(t_s)[0].reshape(self.shape)
        forward = np.stack([c.R[2] for c in self.cameras])  # [C, 3]
        cosine = (self._rays[1].reshape(*self.shape, 3) * forward[:, None, None]).sum(-1)
        return (distance * cosine).astype(np.float32)

    def changed(self, t_s: float) -> np.ndarray:
        """[C, H, W] bool: the pixels of `keys` that are not simply the background: traced or softly lit."""
        return self.traced(t_s) | (self._soft_light.change(t_s) != 0)

    def traced(self, t_s: float) -> np.ndarray:
        """[C, H, W] bool: the pixels that `keys` traces: a mask from rays through the pixels' centres, grown."""
        distance, region = self._hits(t_s)
        region = region.copy()
        open_ = np.flatnonzero(~region & np.isfinite(distance))
        origins, directions = self._rays
        # stop a little short of the surface, so that it does not shadow itself
        points = origins[open_] + directions[open_] * (distance[open_, None] * 0.9995)
        for source in self.world.shadow_sources:
            to_light = source[:3] - source[3] * points
            to_light /= np.linalg.norm(to_light, axis=1, keepdims=True)
            region[open_] |= self._tracer.cast(points, to_light, True)[1]
        size = 2 * _GROW_PX + 1
        return np.asarray(maximum_filter(region.reshape(self.shape), size=(1, size, size)))

    # ------------------------------------------------------------ inner workings

    @cached_property
    def _backgrounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The background at full quality, and its first part alone, which uses the keys' random numbers."""
        parts = [self._whole(self.spp, stream, False) for stream in range(self.background_spp // self.spp)]
        return np.asarray(np.mean(parts, axis=0, dtype=np.float64), dtype=np.float32), parts[0]

    def _whole(self, spp: int, stream: int, moving: bool) -> np.ndarray:
        gray = self._tracer.trace(np.arange(int(np.prod(self.shape))), spp, stream, moving)
        return (gray * np.float32(self.world.exposure)).reshape(self.shape)

    @cached_property
    def _rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions [C*H*W, 3] float64 through the pixel centres."""
        _, height, width = self.shape
        v, u = np.mgrid[:height, :width] + 0.5
        uv = np.stack([u.ravel(), v.ravel()], 1)
        directions = np.concatenate([c.unproject(uv, np.ones(len(uv))) - c.center for c in self.cameras])
        origins = np.repeat(np.stack([c.center for c in self.cameras]), len(uv), axis=0)
        return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def _hits(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Distance and on-instance flag of every pixel's centre ray; the last time's answer is kept."""
        if self._last_hits is None or self._last_hits[0] != t_s:
            self._scene.place(t_s)
            self._last_hits = (t_s, *self._tracer.cast(*self._rays, True))
        return self._last_hits[1:]

    def _trace_at(self, pixels: np.ndarray, spp: int, moving: bool, t_s: float) -> np.ndarray:
        """Radiance [K] of flat pixels with the keys' random numbers, before exposure."""
        if moving:
            self._scene.place(t_s)
        return np.asarray(self._tracer.trace(pixels, spp, 0, moving))

    def _anchor_s(self) -> float:
        """Time between the anchors of soft light."""
        speed = max_image_speed(self.world, self.cameras, self.world.duration_s, samples=5)
        return MOTION_PX / speed if speed > 0 else max(self.world.duration_s, 1e-3)


class ViewRenderer:
    """One camera of a world; the pictures of `MultiViewRenderer` for it alone, [H, W]."""

    def __init__(self, world: WorldScene, camera: Camera, *, seed: int, spp: int, background_spp: int) -> None:
        self._all = MultiViewRenderer(world, [camera], seed=seed, spp=spp, background_spp=background_spp)

    def background(self) -> np.ndarray:
        """[H, W] float32 gray linear radiance without the moving instances."""
        return self._all.backgrounds()[0]

    def key(self, t_s: float) -> np.ndarray:
        """[H, W] float32 at `t_s`: the background outside `changed`, relit or traced inside."""
        return self._all.keys(t_s)[0]

    def changed(self, t_s: float) -> np.ndarray:
        """[H, W] bool: the pixels of `key` that are not simply the background."""
        return self._all.changed(t_s)[0]

    def object_mask(self, t_s: float) -> np.ndarray:
        """[H, W] bool: the pixel's centre sees a moving instance."""
        return self._all.object_masks(t_s)[0]

    def depth(self, t_s: float) -> np.ndarray:
        """[H, W] float32 z-depth at the pixels' centres (inf: nothing there)."""
        return self._all.depths(t_s)[0]

    def reference_frame(self, t_s: float, spp: int) -> np.ndarray:
        """[H, W] float32: every pixel traced by Mitsuba's own render loop."""
        return self._all.reference_frames(t_s, spp)[0]


def _tracer(scene: MitsubaScene, cameras: Sequence[Camera], seed: int) -> Any:
    """The tracer for the process's variant. Imported here because the modules need the variant to be set."""
    if load_mitsuba().variant().startswith("scalar"):
        from spike4dgs.generators.scalar_tiles import TileTracer

        return TileTracer(scene, cameras, seed, MAX_DEPTH)
    from spike4dgs.generators.wavefront import WavefrontTracer

    return WavefrontTracer(scene, cameras, seed, MAX_DEPTH)
