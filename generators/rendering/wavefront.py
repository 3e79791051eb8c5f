"""Tracing lists of pixels with Mitsuba's vectorised variants: all views and all changed pixels in one launch.

Import only after the variant is set: the sampler derives from the variant's `mi.Sampler`.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.special import ndtr

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.rendering.mitsuba_scene import Hits, MitsubaScene, aligned

_LENS_STEPS = 6  # of Newton's method: enough for float32 where a lens moves a pixel by a fifth of the image
_QUANTILES = 4096  # of a blurred pixel's footprint: its variance is right to 1e-3
LANES = 1 << 22  # samples per launch; bounds memory (about 40 bytes each), changes no result
Counts = int | np.ndarray  # a number for all pixels, or one for each [K]


def footprint_quantiles(psf_px: float) -> np.ndarray:
    """Return the quantiles [_QUANTILES + 1] of a point of a pixel, px from its centre along one axis.

    The point is uniform in the pixel plus Gaussian with the standard deviation `psf_px`: samples at such points are the
    blurred image's mean over the pixel, and one number for each axis keeps them stratified. With z = x / psf_px, its
    distribution is psf_px (g(x + 1/2) - g(x - 1/2)), g = z Phi(z) + phi(z).
    """
    reach = 0.5 + 6 * psf_px
    x = np.linspace(-reach, reach, 1 << 16)

    def g(at: np.ndarray) -> np.ndarray:
        z = at / psf_px
        return z * ndtr(z) + np.exp(-z * z / 2) / np.sqrt(2 * np.pi)

    shares = (np.arange(_QUANTILES + 1)) / _QUANTILES
    shares[[0, -1]] = 0.25 / _QUANTILES, 1 - 0.25 / _QUANTILES  # the tails beyond are cut
    return np.interp(shares, psf_px * (g(x + 0.5) - g(x - 0.5)), x)


class PixelSampler(mi.Sampler):  # type: ignore[misc]
    """Correlated multi-jittered samples (Kensler 2013) that depend on the pixel's key and the sample number alone.

    Mitsuba's own samplers number their sequences by lane, so a pixel's samples would change with the list of pixels
    traced. A pixel has 2 ** `bits` samples: the permutations of a power of two need no rejection loop. `bits` is no
    literal of the program, so that one kernel serves all numbers of samples.
    """

    def __init__(self, key: mi.UInt32, index: mi.UInt32, bits: mi.UInt32) -> None:
        super().__init__(mi.Properties())
        self._across, down = (bits + 1) >> 1, bits >> 1
        self._count, self._columns, self._rows = (mi.UInt32(1) << b for b in (bits, self._across, down))
        self._share, self._width, self._height = (1 / mi.Float(n) for n in (self._count, self._columns, self._rows))
        self.key, self.index = key, index
        self.dimension = dr.zeros(mi.UInt32, dr.width(key))

    def next_1d(self, active: mi.Bool = True) -> mi.Float:
        """Return one stratified number per lane, in [0, 1); seldom it rounds to 1."""
        salt = self._next_salt()
        stratum = _shuffle(self.index, self._count, salt)
        return (mi.Float(stratum) + _unit(_hash(salt ^ (self.index * 0x68E31DA4)))) * self._share

    def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
        """Return one point per lane, stratified on the grid and along both axes; a coordinate may round to 1."""
        salt = self._next_salt()
        s = _shuffle(self.index, self._count, salt)
        column, row = s & (self._columns - 1), s >> self._across
        across = _shuffle(row, self._rows, _hash(salt + 0x51633E2D))
        down = _shuffle(column, self._columns, _hash(salt + 0x6B43A9B5))
        jitter = _hash(salt ^ (self.index * 0xB5297A4D))
        x = (mi.Float(column) + (mi.Float(across) + _unit(jitter)) * self._height) * self._width
        y = (mi.Float(row) + (mi.Float(down) + _unit(_hash(jitter))) * self._width) * self._height
        return mi.Point2f(x, y)

    def _next_salt(self) -> mi.UInt32:
        self.dimension = self.dimension + 1
        return _hash(self.key ^ (self.dimension * 0x9E3779B9))


def _hash(x: mi.UInt32) -> mi.UInt32:
    """Return PCG's output permutation (Jarzynski and Olano 2020): 32 bits in, 32 well mixed bits out."""
    x = x * 747796405 + 2891336453
    x = ((x >> ((x >> 28) + 4)) ^ x) * 277803737
    return (x >> 22) ^ x


def _unit(x: mi.UInt32) -> mi.Float:
    """Return the upper 24 bits as a float in [0, 1)."""
    return mi.Float(x >> 8) * (1.0 / (1 << 24))


def _shuffle(i: mi.UInt32, n: mi.UInt32, salt: mi.UInt32) -> mi.UInt32:
    """Return a random permutation of 0..n-1, n a power of two: every step is invertible modulo n."""
    w = n - 1
    i = (i ^ salt) & w
    i = (i * ((salt >> 4) | 1)) & w
    i = i ^ ((i & w) >> 2)
    i = (i * 0xE170893D) & w
    i = i ^ (salt >> 16) & w
    i = i ^ ((i & w) >> 3)
    i = (i * ((salt >> 23) | 1)) & w
    i = i ^ ((i & w) >> 1)
    i = (i * 0x6935FA69) & w
    return (i + (salt >> 9)) & w


@dataclass(frozen=True, eq=False)
class Samples:
    """The samples of a launch, N of K pixels. The lists of pixels end with a zero: one number alone is a scalar."""

    number: mi.UInt32  # [N] place of its pixel in the lists
    pixels: mi.UInt32  # [K + 1] flat
    first: mi.UInt32  # [K + 1] sample
    bits: mi.UInt32  # [K + 1] of the number of samples
    salts: mi.UInt32  # [K + 1]


@dataclass(frozen=True, eq=False)
class Views:
    """What makes the rays of all views; a tree of arrays, for `dr.freeze`."""

    width: mi.UInt32  # a number of the data: of Python's, each size of image would have kernels of its own
    height: mi.UInt32
    keys: mi.UInt32  # [C + 1] numbers of the cameras, and 0: one number alone would be another kernel's
    cameras: mi.Float  # [C * 12] matrices from pixel coordinates to directions, and centres
    lenses: mi.Float | None  # [C * 9] fx, fy, cx, cy, and the distortion
    footprint: mi.Float | None  # quantiles of a blurred pixel, the last one twice: it is read at 1

    @staticmethod
    def of(cameras: Sequence[Camera], psf_px: float) -> Views:
        """Return those of cameras of one resolution."""
        lenses = [[c.fx, c.fy, c.cx, c.cy, *(c.distortion or (0.0,) * 5)] for c in cameras]
        has_lens = any(c.distortion for c in cameras)
        rows = [[*(c.R.T @ np.linalg.inv(c.K)).ravel(), *c.center] for c in cameras]
        return Views(
            dr.opaque(mi.UInt32, cameras[0].width),
            dr.opaque(mi.UInt32, cameras[0].height),
            mi.UInt32(aligned(np.array([*(zlib.crc32(c.id.encode()) for c in cameras), 0], np.uint32))),
            mi.Float(aligned(np.array(rows, np.float32).ravel())),
            mi.Float(aligned(np.array(lenses, np.float32).ravel())) if has_lens else None,
            mi.Float(aligned(np.pad(footprint_quantiles(psf_px), (0, 1), "edge").astype(np.float32)))
            if psf_px
            else None,
        )

    def samples(self, launch: Samples, centre: bool = False) -> tuple[mi.UInt32, PixelSampler, mi.RayDifferential3f]:
        """Return view, sampler and ray of each sample; `centre`: all rays through the middle of their pixel."""
        pixel, first, bits, salt = (
            dr.gather(mi.UInt32, a, launch.number) for a in (launch.pixels, launch.first, launch.bits, launch.salts)
        )
        area = self.width * self.height
        view = pixel // area
        inside = pixel - view * area
        row = inside // self.width
        column = inside - row * self.width
        key = _hash(_hash(inside ^ _hash(dr.gather(mi.UInt32, self.keys, view))) + salt)
        sampler = PixelSampler(key, dr.arange(mi.UInt32, dr.width(launch.number)) - first, bits)
        offset = mi.Point2f(0.5) if centre else sampler.next_2d()
        if self.footprint is not None and not centre:
            offset = mi.Point2f(self._blurred(offset.x), self._blurred(offset.y))
        return view, sampler, self._ray(view, mi.Float(column) + offset.x, mi.Float(row) + offset.y)

    def _blurred(self, u: mi.Float) -> mi.Float:
        """Return the place in a blurred pixel, px from its left or upper edge, of numbers in [0, 1]: one each way."""
        at = u * _QUANTILES
        first = mi.UInt32(at)
        low, high = (dr.gather(mi.Float, self.footprint, first + k) for k in (0, 1))
        return 0.5 + low + (high - low) * (at - mi.Float(first))

    def _ray(self, view: mi.UInt32, u: mi.Float, v: mi.Float) -> mi.RayDifferential3f:
        def number(k: int) -> mi.Float:
            return dr.gather(mi.Float, self.cameras, view * 12 + k)

        if self.lenses is not None:
            u, v = self._straightened(view, u, v)
        d = [number(3 * k) * u + number(3 * k + 1) * v + number(3 * k + 2) for k in range(3)]
        ray = dr.zeros(mi.RayDifferential3f, dr.width(view))
        ray.o = mi.Point3f(number(9), number(10), number(11))
        ray.d = dr.normalize(mi.Vector3f(*d))
        ray.maxt = dr.largest(mi.Float)
        return ray

    def _straightened(self, view: mi.UInt32, u: mi.Float, v: mi.Float) -> tuple[mi.Float, mi.Float]:
        """Return the pinhole's pixel coordinates of the lens's, by Newton's method as in `lens.undistort`."""
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = (dr.gather(mi.Float, self.lenses, view * 9 + k) for k in range(9))
        wanted_x, wanted_y = (u - cx) / fx, (v - cy) / fy
        x, y = wanted_x, wanted_y
        for _ in range(_LENS_STEPS):
            s = x * x + y * y
            radial = 1 + s * (k1 + s * (k2 + s * k3))
            slope = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
            a = wanted_x - (x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x))
            b = wanted_y - (y * radial + 2 * p2 * x * y + p1 * (s + 2 * y * y))
            xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
            xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
            yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
            determinant = xx * yy - xy * xy
            x, y = x + (yy * a - xy * b) / determinant, y + (xx * b - xy * a) / determinant
        return x * fx + cx, y * fy + cy


class WavefrontTracer:
    """Traces pixels of several views at once. Pixels are flat numbers: (view * height + row) * width + column."""

    def __init__(
        self, scene: MitsubaScene, cameras: Sequence[Camera], seed: int, max_depth: int, psf_px: float = 0.0
    ) -> None:
        self._scene, self._seed = scene, seed
        self._views = Views.of(cameras, psf_px)
        self._integrator = mi.load_dict({"type": "path", "max_depth": max_depth})
        by_id = {shape.id(): shape for shape in scene.movers.shapes()}
        self._movers = [mi.ShapePtr(by_id[name]) for name in scene.mover_ids]

    def trace(self, pixels: np.ndarray, spp: int, stream: int, moving: bool) -> np.ndarray:
        """Return the linear RGB radiance [K, 3] float32 of flat `pixels` [K], mean of `spp` samples (a power of two).

        A pixel's samples are a function of (seed, camera id, row, column, spp, stream) alone.
        """
        per_launch = max(LANES // spp, 1)
        parts = [
            self._launch(pixels[k : k + per_launch], spp, stream, moving) for k in range(0, len(pixels), per_launch)
        ]
        return np.concatenate(parts) if parts else np.zeros((0, 3), np.float32)

    def _launch(self, pixels: np.ndarray, spp: int, stream: int, moving: bool) -> np.ndarray:
        _, sampler, ray = self._views.samples(self._lanes(pixels, spp, stream))
        radiance, _, _ = self._integrator.sample(self._scene_at(moving), sampler, ray)
        return self._means(radiance, spp)

    def _scene_at(self, moving: bool) -> mi.Scene:
        return self._scene.full if moving else self._scene.empty

    def _lanes(self, pixels: np.ndarray, spp: Counts, stream: Counts) -> Samples:
        """Return the samples of a launch."""
        counts, streams = (np.broadcast_to(a, pixels.shape) for a in (spp, stream))
        salts = (
            np.uint64(self._seed * 0x2545F491 & 0xFFFFFFFF)
            + streams.astype(np.uint64) * 0x9E3779B1
            + counts.astype(np.uint64)
        )
        return Samples(
            mi.UInt32(aligned(np.repeat(np.arange(len(pixels), dtype=np.uint32), counts))),
            *(
                mi.UInt32(aligned(np.append(a, 0).astype(np.uint32)))
                for a in (pixels, np.cumsum(counts) - counts, np.log2(counts), salts & 0xFFFFFFFF)
            ),
        )

    def _means(self, values: mi.Color3f, spp: Counts) -> np.ndarray:
        """Return the means [K, 3] float32 of each pixel's samples."""
        dr.eval(values)  # the path kernel writes one colour per sample; the reductions below read it
        if not isinstance(spp, int):
            first = np.cumsum(spp) - spp
            sums = np.stack([np.add.reduceat(np.array(c, np.float32), first) for c in values], 1)
            return np.asarray(sums / spp[:, None].astype(np.float32))
        return np.stack([np.array(dr.block_sum(c, spp), np.float32) for c in values], 1) / np.float32(spp)

    def prepare(self, origins: np.ndarray, directions: np.ndarray) -> mi.Ray3f:
        """Return rays [N, 3] with unit directions, prepared for repeated casts."""
        o, d = (
            mi.Vector3f(*(mi.Float(aligned(axis.astype(np.float32))) for axis in a.T)) for a in (origins, directions)
        )
        ray = mi.Ray3f(mi.Point3f(o), d)
        dr.eval(ray)
        return ray

    def cast_static(self, rays: mi.Ray3f, scene: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Cast rays at a scene: if None, at the static surfaces that are opaque.

        Return distance [N] (inf: no hit) and surface normal [N, 3], float32.
        """
        scene = scene or self._scene.opaque
        hit = scene.ray_intersect(rays)
        distance = dr.select(hit.is_valid(), hit.t, dr.inf)
        dr.eval(distance, hit.n)
        return np.array(distance), np.array(hit.n).T

    def cast_movers(self, rays: mi.Ray3f) -> Hits:
        """Cast rays at the moving objects alone; static surfaces hide nothing."""
        hit = self._scene.movers.ray_intersect_preliminary(rays)
        number = mi.Int32(-1)
        for k, shape in enumerate(self._movers):
            number = dr.select(hit.is_valid() & (hit.shape == shape), k, number)
        distance = dr.select(hit.is_valid(), hit.t, dr.inf)
        face, uv = (dr.select(hit.is_valid(), a, 0) for a in (hit.prim_index, hit.prim_uv))
        dr.eval(distance, number, face, uv)
        where = np.array(face, np.int64), np.array(uv, np.float64).T
        return self._scene.hits(np.array(distance), np.array(number), *where)
