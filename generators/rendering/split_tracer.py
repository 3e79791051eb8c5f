"""The paths of `wavefront` in two parts: direct light, and soft light from other surfaces and from the sky.

Radiance at a surface point is the sum of

- *direct* light: what the point emits, and the sampled lamps' light by next event. Two rays, and nearly free of noise;
- *soft* light: the paths that continue from samples of the matte lobe and of a coat's gloss. They hold nearly all of
  the noise and of the time, and what they give is smooth on every surface, matte light once it is divided by the
  albedo. It comes from a `SoftMap`, which the caller fills for some times and smooths. Samples that find no like
  surface there trace one path, and so do those on metal, whose reflections are sharp and strong.

Lamps count once: soft light of maps leaves out lamps that `direct` samples; on metal both have weights (multiple
importance sampling, squared densities). But for `most_light`, the sum equals `WavefrontTracer.trace` in the mean; tests
compare both.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.rendering.mitsuba_scene import MitsubaScene
from spike4dgs.generators.rendering.soft_map import LEAST_WEIGHT, SoftMap, SoftMaps
from spike4dgs.generators.rendering.wavefront import LANES, Counts, Samples, Views, WavefrontTracer

PILOT = 4  # samples from which the number of a pixel's samples is chosen, a power of two
_LEAST_ALBEDO = 1e-3
# Radiance of a soft path, at most: some four times that of white paper in the sun. Rarely a path finds a caustic, the
# sun in somebody's varnish, which is twenty times as bright; smoothed, it would be a spot of several pixels.
_MOST_LIGHT = 4.0


class SplitTracer(WavefrontTracer):
    """Traces both parts; a pixel's samples are a function of (seed, camera id, row, column, spp, stream) alone."""

    def __init__(
        self, scene: MitsubaScene, cameras: Sequence[Camera], seed: int, max_depth: int, psf_px: float = 0.0
    ) -> None:
        super().__init__(scene, cameras, seed, max_depth, psf_px)
        self._rest = mi.load_dict({"type": "path", "max_depth": max_depth - 1})
        self._has_lamp = any(mi.has_flag(e.flags(), mi.EmitterFlags.Surface) for e in scene.empty.emitters())
        self._all, self._matte, self._glossy = mi.BSDFContext(), mi.BSDFContext(), mi.BSDFContext()
        self._matte.type_mask, self._glossy.type_mask = mi.BSDFFlags.Diffuse, mi.BSDFFlags.Glossy
        self._maps = SoftMaps.of(scene, cameras)
        self.most_light = _MOST_LIGHT
        # Tracing the program of a launch takes a third as long as its samples, so it is recorded once.
        self._radiance_of: Callable[..., mi.Color3f] = self._radiance
        self._soft_of: Callable[..., mi.Color3f] = self._soft
        if scene.keeps_buffers:
            self._radiance_of, self._soft_of = _Recorded(self._radiance), _Recorded(self._soft)

    # ------------------------------------------------------------ the parts

    def split(
        self, pixels: np.ndarray, spp: Counts, stream: Counts, moving: bool, maps: Sequence[tuple[float, SoftMap]]
    ) -> np.ndarray:
        """Return the linear RGB radiance [K, 3] float32, with soft light of `maps` (weight, map), blended."""
        parts, known = [np.zeros((0, 3), np.float32)], _opaque(maps)
        for some, counts, streams in _launches(pixels, spp, stream):
            radiance = self._radiance_of(*self._launch_of(some, counts, streams, moving), moving, self._maps, known)
            parts.append(self._means(radiance, counts))
        return np.concatenate(parts)

    def spread(
        self, pixels: np.ndarray, stream: Counts, moving: bool, maps: Sequence[tuple[float, SoftMap]]
    ) -> np.ndarray:
        """Return the standard deviations [K] of PILOT samples of each pixel's gray radiance, as `split` has them."""
        parts, known = [np.zeros((0, PILOT), np.float32)], _opaque(maps)
        for some, _, streams in _launches(pixels, PILOT, stream):
            radiance = self._radiance_of(*self._launch_of(some, PILOT, streams, moving), moving, self._maps, known)
            dr.eval(radiance)
            parts.append(gray(np.stack([np.array(c, np.float32) for c in radiance], 1)).reshape(-1, PILOT))
        return np.asarray(np.concatenate(parts).std(1, ddof=1))

    def surfaces(self, pixels: np.ndarray, moving: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the points and normals [K, 3] that the centres of `pixels` see (0: nothing), and which have a coat."""
        _, _, ray = self._views.samples(self._lanes(pixels, 1, 0), centre=True)
        si = self._scene_at(moving).ray_intersect(ray)
        points, normals = (dr.select(si.is_valid(), a, 0) for a in (si.p, si.n))
        shiny = dr.select(_lobes(si, si.bsdf(ray))[1], mi.UInt32(1), 0)
        dr.eval(points, normals, shiny)
        at, normal = (np.ascontiguousarray(np.array(a, np.float32).T) for a in (points, normals))
        return at, normal, np.array(shiny) > 0

    def soft(self, pixels: np.ndarray, spp: Counts, stream: Counts, moving: bool, *, gloss: bool) -> np.ndarray:
        """Return soft light [K, 3] at the centres of `pixels`, means of paths: gloss, or matte over albedo."""
        parts = [np.zeros((0, 3), np.float32)]
        for some, counts, streams in _launches(pixels, spp, stream):
            light = self._soft_of(*self._launch_of(some, counts, streams, moving), gloss)
            parts.append(self._means(light, counts))
        return np.concatenate(parts)

    # ------------------------------------------------------------ internals

    def _launch_of(
        self, pixels: np.ndarray, spp: Counts, stream: Counts, moving: bool
    ) -> tuple[mi.Scene, Views, Samples]:
        """Return the inputs of a launch."""
        return self._scene_at(moving), self._views, self._lanes(pixels, spp, stream)

    def _soft(self, scene: mi.Scene, views: Views, samples: Samples, gloss: bool) -> mi.Color3f:
        """Return the soft light of one lobe by each sample."""
        _, sampler, ray = views.samples(samples, centre=True)
        si = scene.ray_intersect(ray)
        bsdf = si.bsdf(ray)
        matte, coated, _ = _lobes(si, bsdf)
        if gloss:
            return self._scattered(scene, si, bsdf, self._glossy, sampler, coated)
        light = self._scattered(scene, si, bsdf, self._matte, sampler, matte)
        return light / dr.maximum(bsdf.eval_diffuse_reflectance(si, matte), _LEAST_ALBEDO)

    def _radiance(
        self,
        scene: mi.Scene,
        views: Views,
        samples: Samples,
        moving: bool,
        objects: SoftMaps,
        maps: Sequence[tuple[mi.Float, SoftMap]],
    ) -> mi.Color3f:
        """Return the radiance of each sample."""
        view, sampler, ray = views.samples(samples)
        hit = scene.ray_intersect_preliminary(ray)
        si = hit.compute_surface_interaction(ray)
        bsdf = si.bsdf(ray)
        matte, coated, metal = _lobes(si, bsdf)
        light = si.emitter(scene).eval(si) + self._sampled_light(scene, si, bsdf, metal, sampler)
        places = [objects.place(view, si, hit, share, known, moving, matte) for share, known in maps]
        on_albedo, gloss, weight = objects.looked_up(view, places, matte)
        known_here = matte & (weight > LEAST_WEIGHT)
        albedo = bsdf.eval_diffuse_reflectance(si, matte)
        light += dr.select(known_here, (albedo * on_albedo + dr.select(coated, gloss, 0)) / weight, 0)
        traced = si.is_valid() & ~known_here
        return light + self._scattered(scene, si, bsdf, self._all, sampler, traced, metal)

    def _sampled_light(
        self, scene: mi.Scene, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, metal: mi.Bool, sampler: mi.Sampler
    ) -> mi.Color3f:
        """Return the light of sampled lamps that a surface reflects; on metal its share of it."""
        ds, weight = scene.sample_emitter_direction(si, sampler.next_2d(), True, si.is_valid())
        lit = si.is_valid() & (ds.pdf != 0)
        value, density = bsdf.eval_pdf(self._all, si, si.to_local(ds.d), lit)
        share = dr.select(ds.delta | ~metal, 1, _balance(ds.pdf, density))
        return dr.select(lit, value * share * weight, 0)

    def _scattered(
        self,
        scene: mi.Scene,
        si: mi.SurfaceInteraction3f,
        bsdf: mi.BSDFPtr,
        lobe: mi.BSDFContext,
        sampler: mi.Sampler,
        active: mi.Bool,
        metal: mi.Bool | None = None,
    ) -> mi.Color3f:
        """Return the light of the path that continues from one sample of a lobe, without what `direct` has of lamps."""
        bs, weight = bsdf.sample(lobe, si, sampler.next_1d(), sampler.next_2d(), active)
        active = active & (bs.pdf > 0)
        ray = si.spawn_ray(si.to_world(bs.wo))
        light, _, _ = self._rest.sample(scene, sampler, mi.RayDifferential3f(ray), None, active)
        if self._has_lamp:
            met = scene.ray_intersect(ray, active)
            emitter = met.emitter(scene)
            lamp = active & met.is_valid() & (emitter != None)  # noqa: E711 (an array of pointers)
            kept = mi.Float(0)
            if metal is not None:
                ds = mi.DirectionSample3f(scene, met, si)
                kept = dr.select(metal, _balance(bs.pdf, scene.pdf_emitter_direction(si, ds, lamp & metal)), 0)
            light -= dr.select(lamp, emitter.eval(met, lamp) * (1 - kept), 0)
        return dr.select(active, weight * dr.minimum(light, self.most_light), 0)


class _Recorded:
    """A function whose program is traced once for arguments of a kind."""

    def __init__(self, function: Callable[..., mi.Color3f]) -> None:
        self.frozen = dr.freeze(function)

    def __call__(self, *arguments: Any) -> mi.Color3f:
        # The collector may free an array of NumPy's memory, such as an old renderer's, and Dr.Jit ends the process
        # where that happens in a recording.
        was_on = gc.isenabled()
        gc.disable()
        try:
            return self.frozen(*arguments)
        finally:
            if was_on:
                gc.enable()


def _opaque(maps: Sequence[tuple[float, SoftMap]]) -> list[tuple[mi.Float, SoftMap]]:
    """Return the maps with weights that are no literals of the program."""
    return [(dr.opaque(mi.Float, weight), known) for weight, known in maps]


def _launches(pixels: np.ndarray, spp: Counts, stream: Counts) -> Iterator[tuple[np.ndarray, Counts, Counts]]:
    """Yield pixels, numbers of samples and streams of each launch, of about LANES samples at most."""
    ends = np.cumsum(spp) if isinstance(spp, np.ndarray) else spp * np.arange(1, len(pixels) + 1)
    launch = ends // LANES  # neighbours in the list stay together
    bounds = [0, *(np.flatnonzero(np.diff(launch)) + 1).tolist(), len(pixels)]
    for a, b in zip(bounds[:-1], bounds[1:], strict=True):
        if a < b:
            yield pixels[a:b], *(x if isinstance(x, int) else x[a:b] for x in (spp, stream))  # type: ignore[misc]


def _lobes(si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr) -> tuple[mi.Bool, mi.Bool, mi.Bool]:
    """Return which surfaces are matte, which of these have a glossy coat, and which are metal."""
    matte = si.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
    glossy = si.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)
    return matte, matte & glossy, ~matte & glossy


def _balance(own: mi.Float, other: mi.Float) -> mi.Float:
    """Return the weight of a sample by multiple importance sampling with squared densities."""
    own, other = own * own, other * other
    return dr.select(own > 0, own / (own + other), 0)
