"""Key frames of a world: the background once, and at each time only the pixels that moving objects change.

Three kinds of pixel, cheapest first:

- *Static*: the background, rendered once with many samples.
- *Softly lit* (bounced light, wide penumbrae): the background times a slowly varying factor, see `soft_light`.
- *Traced* at every key: a ray through the pixel's centre meets a moving object, or the surface that it meets has one
  between itself and the light; both regions are grown by 3 px (`visibility`). So are reflections in planar mirrors.

Keys between two coarse ones hold only traced pixels whose motion is too fast for the coarse ones (`image_motion`).

Common random numbers: a pixel's samples depend on (seed, camera, pixel, number of samples) only. Static surfaces keep
their noise from key to key, and a list of pixels traced alone equals the same pixels of the whole image, bit for bit.
Traced pixels that see only the shadow of a moving surface get the background plus the *difference* of two such
renderings: the low noise of the background remains, and there is no step at the edge of the traced region.

This module does not: blur motion (a key is an instant), filter (a pixel is the box mean of its area, after
the optics' blur where there is one), or denoise; `split_render` has less noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.rendering.image_motion import KeyPlan, max_image_speed
from spike4dgs.generators.rendering.mitsuba_scene import mitsuba_scene
from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.generators.rendering.soft_light import MOTION_PX, SoftLight
from spike4dgs.generators.rendering.visibility import Visibility
from spike4dgs.generators.worlds import WorldScene

MAX_DEPTH = 4  # camera, surface, two bounces


@dataclass(frozen=True, eq=False)
class SoftStatic:
    """Soft light in the views without moving objects, float32; see `split_render`.

    Attributes:
        points, normals: [C, H, W, 3], surface points at the pixels' centres; normals are 0 without one.
        paths: [C, H, W] int32, of matte light at each pixel.
        first: [C, H, W, 6], soft light with the random numbers of keys: matte over the albedo, gloss.
        smooth: the same, smoothed.
    """

    points: np.ndarray
    normals: np.ndarray
    paths: np.ndarray
    first: np.ndarray
    smooth: np.ndarray


@dataclass(frozen=True, eq=False)
class StaticViews:
    """The views without moving objects, linear RGB [C, H, W, 3] float32.

    `background` is at full quality; `first` has the noise of keys, and may be the same. `soft` and `samples` [C, H, W],
    numbers of samples, are of a `split_render.SplitRenderer`.
    """

    background: np.ndarray
    first: np.ndarray
    soft: SoftStatic | None = None
    samples: np.ndarray | None = None

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays for a file or another process."""
        soft = {f"soft_{name}": array for name, array in vars(self.soft).items()} if self.soft else {}
        soft |= {"samples": self.samples} if self.samples is not None else {}
        first = {} if self.first is self.background else {"first": self.first}
        return {"background": self.background, **first, **soft}

    @staticmethod
    def from_arrays(arrays: Mapping[str, np.ndarray]) -> StaticViews:
        """Return the views from the result of `arrays`."""
        soft = {name.removeprefix("soft_"): a for name, a in arrays.items() if name.startswith("soft_")}
        given = SoftStatic(**soft) if soft else None, arrays.get("samples")
        return StaticViews(arrays["background"], arrays.get("first", arrays["background"]), *given)

    def views(self, chosen: Sequence[int]) -> StaticViews:
        """Return a selection of the views."""
        return self.from_arrays({name: array[list(chosen)] for name, array in self.arrays().items()})


class MultiViewRenderer(Visibility):
    """Renders all `cameras` (one resolution) of a world together: one launch per time. Images are [C, H, W] float32.

    For example::

        renderer = MultiViewRenderer(world, cameras(world, 200, 125), seed=0, spp=64, background_spp=256)
        images = [renderer.keys(t_s) for t_s in np.arange(0, 0.02, 0.0005)]
    """

    def __init__(
        self,
        world: WorldScene,
        cameras: Sequence[Camera],
        *,
        seed: int,
        spp: int,
        background_spp: int,
        color: bool = False,
        static: StaticViews | None = None,
        whole_frames: bool = False,
        psf_px: float = 0.0,
    ) -> None:
        """Load the world into Mitsuba (about a second). Raises UserError for numbers of samples that do not fit.

        Args:
            world: the world to render.
            cameras: views of one resolution.
            seed: of all random numbers.
            spp: samples per pixel of keys, a power of two.
            background_spp: samples per pixel of the static background, a power of two, at least `spp`.
            color: images are linear RGB, [C, H, W, 3].
            static: `static` of a renderer with the same arguments; if None, it is rendered when needed.
            whole_frames: trace every pixel of coarse keys, slow and exact; finer ones, of objects and shadows alone.
            psf_px: standard deviation of the optics' blur, a Gaussian, before the pixel's box; 0 is off.
        """
        for name, value in (("spp", spp), ("background_spp", background_spp)):
            if value < 1 or value & (value - 1):
                raise problem(name, "a power of two", str(value), "give 16, 32, 64, ...")
        if background_spp < spp:
            raise problem("background_spp", f"at least spp = {spp}", str(background_spp), "raise it")
        if len({(c.width, c.height) for c in cameras}) != 1:
            raise problem("cameras", "one resolution for all", "several or none", "render them apart")
        scene = mitsuba_scene(world)
        super().__init__(world, cameras, scene)
        self._tracer = self._make_tracer(seed, psf_px)
        self.spp, self.background_spp, self.color, self.whole_frames = spp, background_spp, color, whole_frames
        self._seed = seed
        self._soft_light = SoftLight(self.shape, self._gray_at, super().traced, anchor_s(world, cameras, MOTION_PX))
        if static is not None:
            self.static = static

    def _make_tracer(self, *settings: Any) -> Any:
        return make_tracer(self._scene, self.cameras, *settings)

    @cached_property
    def static(self) -> StaticViews:
        """The views without moving objects."""
        background, first = self.static_at(np.arange(int(np.prod(self.shape))))
        return StaticViews(background.reshape(*self.shape, 3), first.reshape(*self.shape, 3))

    def static_at(self, pixels: np.ndarray, background: bool = True) -> tuple[np.ndarray, ...]:
        """Return the parts `background` and `first` of `static` [K, 3] at flat pixels, or the latter alone."""
        first = self._rgb_at(pixels, self.spp, 0, None)
        if not background:
            return (first,)
        total = first.astype(np.float64)
        parts = self.background_spp // self.spp
        for stream in range(1, parts):
            total += self._rgb_at(pixels, self.spp, stream, None)
        return (total / parts).astype(np.float32), first

    @cached_property
    def background(self) -> np.ndarray:
        """`static.background` in the format of the images: [C, H, W], or in colour [C, H, W, 3]."""
        return self.static.background if self.color else gray(self.static.background)

    def keys(self, t_s: float) -> np.ndarray:
        """Return the views at `t_s`, composed of static, softly lit and traced pixels."""
        if self.whole_frames:
            return self.crn_frames(t_s)
        change = self._soft_light.change(t_s)
        image = self.background * (1 + (change[..., None] if self.color else change))
        where = np.flatnonzero(self.traced(t_s))
        self._flat(image)[where] = self._traced_at(where, t_s)
        return image

    def key_arrays(self, tick: int, plan: KeyPlan) -> dict[str, np.ndarray]:
        """Return the arrays of a tick for `KeyStore`: for each view v the given pixels (packed) and their values.

        Coarse keys (`given{v}`, `values{v}`) give the pixels that differ from the background, finer keys those that
        move too fast for the coarser keys. With sub-ticks, `mean_given{v}` and `mean_values{v}` are the mean radiance
        over the tick where the motion is too fast even for that. The result depends on the arguments alone, not on
        earlier renderings.
        """
        t_s, level = tick / plan.rate_hz, plan.level(tick)
        if level == 0:
            image = self.keys(t_s)
            given = np.ones(self.shape, bool) if self.whole_frames else image != self.background
            values = image.ravel()[given.ravel()]
        else:
            given = self._fast(t_s, plan.chain[level - 1] / plan.rate_hz, plan.max_px)
            values = self._traced_at(np.flatnonzero(given), t_s)
        arrays = self._sparse("given", "values", given, values)
        if plan.sub_ticks > 1 and tick < plan.n_ticks:
            fast = self._fast(t_s + 0.5 / plan.rate_hz, 1 / plan.rate_hz, plan.max_px)
            means = self._means_at(np.flatnonzero(fast), t_s, plan)
            arrays |= self._sparse("mean_given", "mean_values", fast, means)
        return arrays

    def crn_frames(self, t_s: float) -> np.ndarray:
        """Return all pixels traced at `t_s` with the random numbers of `keys`, to measure the error of `keys`."""
        rgb = self._rgb_at(np.arange(int(np.prod(self.shape))), self.spp, 0, t_s).reshape(*self.shape, 3)
        return rgb if self.color else gray(rgb)

    def reference_frames(self, t_s: float, spp: int) -> np.ndarray:
        """Return the views at `t_s` by Mitsuba's own render loop, sensor, film and sampler; no pixel is reused."""
        mi = load_mitsuba()
        from spike4dgs.generators.rendering.scalar_tiles import load_sensor

        self._scene.set_time(t_s)
        integrator = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH})
        seed, frames = (self._seed + 1) % (1 << 32), []  # Mitsuba takes 32 bits
        for camera in self.cameras:
            sensor = load_sensor(camera, {"type": "hdrfilm", "width": camera.width, "height": camera.height}, spp)
            rgb = np.array(mi.render(self._scene.full, sensor=sensor, integrator=integrator, seed=seed))
            frames.append(rgb[..., :3] if self.color else gray(rgb[..., :3]))
        return np.stack(frames) * np.float32(self.world.exposure)

    def changed(self, t_s: float) -> np.ndarray:
        """Return [C, H, W] bool: the pixels of `keys` that are not plain background, but traced or softly lit."""
        return self.traced(t_s) | (self._soft_light.change(t_s) != 0)

    def traced(self, t_s: float) -> np.ndarray:
        """Return [C, H, W] bool: the pixels that `keys` traces."""
        return np.ones(self.shape, bool) if self.whole_frames else super().traced(t_s)

    # ------------------------------------------------------------ internals

    def _traced_at(self, where: np.ndarray, t_s: float) -> np.ndarray:
        """Return the radiance [K] or [K, 3] of the flat pixels `where` of a key."""
        rgb = self._rgb_at(where, self.spp, 0, t_s)
        traced = rgb if self.color else gray(rgb)
        if self.whole_frames:
            return traced
        correction = self._flat(self.background)[where] - self._flat(self._first)[where]
        correction[self.moving_masks(t_s).ravel()[where]] = 0
        return np.maximum(traced + correction, 0)

    @cached_property
    def _first(self) -> np.ndarray:
        return self.static.first if self.color else gray(self.static.first)

    def _means_at(self, where: np.ndarray, t_s: float, plan: KeyPlan) -> np.ndarray:
        """Return the mean radiance [K] of flat pixels over the tick from `t_s` on, from `plan.sub_ticks` instants."""
        shares = (np.arange(plan.sub_ticks) + 0.5) / plan.sub_ticks
        return np.mean([self._traced_at(where, t_s + share / plan.rate_hz) for share in shares], axis=0)

    def _fast(self, t_s: float, within_s: float, max_px: float) -> np.ndarray:
        """Return [C, H, W] bool: traced pixels with a motion of more than `max_px` px in `within_s` seconds."""
        return super().traced(t_s) & (self.speeds(t_s) * within_s > max_px)

    def _rgb_at(self, pixels: np.ndarray, spp: int, stream: int, t_s: float | None) -> np.ndarray:
        """Return linear RGB [K, 3] of flat pixels; `t_s` None: without moving objects."""
        if t_s is not None:
            self._scene.set_time(t_s)
        return np.asarray(self._tracer.trace(pixels, spp, stream, t_s is not None) * np.float32(self.world.exposure))

    def _gray_at(self, pixels: np.ndarray, spp: int, moving: bool, t_s: float) -> np.ndarray:
        """Return the gray radiance [K], before exposure, of flat pixels with the keys' random numbers."""
        if moving:
            self._scene.set_time(t_s)
        return gray(self._tracer.trace(pixels, spp, 0, moving))

    def _flat(self, image: np.ndarray) -> np.ndarray:
        """Return a view of the image, [N] or [N, 3]."""
        return image.reshape(-1, 3) if self.color else image.reshape(-1)

    def _sparse(self, mask_name: str, values_name: str, given: np.ndarray, values: np.ndarray) -> dict[str, np.ndarray]:
        bounds = np.concatenate([[0], np.cumsum(given.reshape(len(given), -1).sum(1))])
        arrays: dict[str, np.ndarray] = {}
        for v, mask in enumerate(given):
            arrays[f"{mask_name}{v}"] = np.packbits(mask)
            arrays[f"{values_name}{v}"] = values[bounds[v] : bounds[v + 1]].astype(np.float32)
        return arrays


def anchor_s(world: WorldScene, cameras: Sequence[Camera], motion_px: float) -> float:
    """Return the time between anchors of soft light, in which no point moves farther at its speed at 5 instants."""
    speed = max_image_speed(world, cameras, world.duration_s, samples=5)
    return motion_px / speed if speed > 0 else max(world.duration_s, 1e-3)


def make_tracer(scene: Any, cameras: Sequence[Camera], seed: int, psf_px: float = 0.0) -> Any:
    """Return the tracer for the process's variant. Imports are here because the modules need the variant to be set.

    Raises UserError for a blur where the variant cannot render it.
    """
    if load_mitsuba().variant().startswith("scalar"):
        if psf_px:
            fix = "install libLLVM, see `spike4dgs doctor`, or use --device cuda"
            raise problem("--psf-px", "Mitsuba's LLVM or CUDA variant", "the scalar variant", fix)
        from spike4dgs.generators.rendering.scalar_tiles import TileTracer

        return TileTracer(scene, cameras, seed, MAX_DEPTH)
    from spike4dgs.generators.rendering.wavefront import WavefrontTracer

    return WavefrontTracer(scene, cameras, seed, MAX_DEPTH, psf_px)
