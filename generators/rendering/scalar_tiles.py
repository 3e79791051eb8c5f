"""The same tracing interface with Mitsuba's scalar variants: slower, needs no libLLVM.

Python cannot call the scalar integrator per sample (a call costs more than a path), so pixels are rendered in fixed
square tiles by `mi.render`. A tile's seed depends on (seed, camera, tile, stream), never on the other traced pixels.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from spike4dgs.benchmark.scene.cameras import Camera, mitsuba_sensor, mitsuba_to_world
from spike4dgs.generators.rendering.mitsuba_scene import Hits, MitsubaScene

_TILE = 16

Rays = tuple[np.ndarray, np.ndarray]


class TileTracer:
    """Traces pixels of several views. Pixels are flat numbers: (view * height + row) * width + column."""

    def __init__(self, scene: MitsubaScene, cameras: Sequence[Camera], seed: int, max_depth: int) -> None:
        self._scene, self._cameras, self._seed = scene, cameras, seed
        self._width, self._height = cameras[0].width, cameras[0].height
        # blocks smaller than a tile, so that all cores work on one tile
        self._integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "block_size": _TILE // 2})
        self._sensors: dict[tuple[int, int, int, int], Any] = {}

    def trace(self, pixels: np.ndarray, spp: int, stream: int, moving: bool) -> np.ndarray:
        """Return the linear RGB radiance [K, 3] float32 of flat `pixels` [K], mean of `spp` samples.

        A pixel's samples are a function of (seed, camera id, row, column, spp, stream) alone.
        """
        view, inside = np.divmod(pixels, self._width * self._height)
        row, column = np.divmod(inside, self._width)
        tiles = np.stack([view, row // _TILE, column // _TILE], 1)
        wanted, which = np.unique(tiles, axis=0, return_inverse=True)
        which = which.ravel()
        out = np.zeros((len(pixels), 3), np.float32)
        for k, (v, y, x) in enumerate(wanted.tolist()):
            mine = which == k
            tile = self._tile(v, y, x, spp, stream, moving)
            out[mine] = tile[row[mine] - y * _TILE, column[mine] - x * _TILE]
        return out

    def _tile(self, view: int, y: int, x: int, spp: int, stream: int, moving: bool) -> np.ndarray:
        key = (view, y, x, spp)
        if key not in self._sensors:
            self._sensors[key] = self._sensor(*key)
        scene = self._scene.full if moving else self._scene.empty
        name = f"{self._seed} {self._cameras[view].id} {y} {x} {stream}"
        image = mi.render(scene, sensor=self._sensors[key], integrator=self._integrator, seed=zlib.crc32(name.encode()))
        return np.asarray(image, np.float32)[..., :3]

    def _sensor(self, view: int, y: int, x: int, spp: int) -> Any:
        camera = self._cameras[view]
        film = {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "crop_offset_x": x * _TILE,
            "crop_offset_y": y * _TILE,
            "crop_width": min(_TILE, camera.width - x * _TILE),
            "crop_height": min(_TILE, camera.height - y * _TILE),
        }
        return load_sensor(camera, film, spp)

    def prepare(self, origins: np.ndarray, directions: np.ndarray) -> Rays:
        """Return rays [N, 3] with unit directions, prepared for repeated casts."""
        return origins, directions

    def cast_static(self, rays: Rays, scene: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Cast rays at a scene: if None, at the static surfaces that are opaque.

        Return distance [N] (inf: no hit) and surface normal [N, 3], float32.
        """
        scene = scene or self._scene.opaque
        distance, normal = np.full(len(rays[0]), np.inf, np.float32), np.zeros((len(rays[0]), 3), np.float32)
        for k, (o, d) in enumerate(zip(*(a.tolist() for a in rays), strict=True)):
            hit = scene.ray_intersect(mi.Ray3f(o, d))
            if hit.is_valid():
                distance[k], normal[k] = hit.t, hit.n
        return distance, normal

    def cast_movers(self, rays: Rays) -> Hits:
        """Cast rays at the moving objects alone; static surfaces hide nothing."""
        n = len(rays[0])
        distance, number = np.full(n, np.inf, np.float32), np.full(n, -1, np.int32)
        face, uv = np.zeros(n, np.int64), np.zeros((n, 2))
        numbers = {name: k for k, name in enumerate(self._scene.mover_ids)}
        for k, (o, d) in enumerate(zip(*(a.tolist() for a in rays), strict=True)):
            hit = self._scene.movers.ray_intersect_preliminary(mi.Ray3f(o, d))
            if hit.is_valid():
                distance[k], number[k] = hit.t, numbers[hit.shape.id()]
                face[k], uv[k] = hit.prim_index, list(hit.prim_uv)
        return self._scene.hits(distance, number, face, uv)


def load_sensor(camera: Camera, film: dict[str, Any], spp: int) -> Any:
    """Return a Mitsuba sensor of `camera` with a box-filtered linear film, whole or cropped; at least `spp` samples."""
    rows = math.isqrt(spp)
    strata = rows * -(-spp // rows)  # Mitsuba would take as many itself, with a warning for every sensor
    return mi.load_dict(
        {
            "type": "perspective",
            **mitsuba_sensor(camera),
            "near_clip": 0.01,
            "far_clip": 1e4,
            "to_world": mi.ScalarTransform4f(mitsuba_to_world(camera)),
            "film": {
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
                **film,
            },
            "sampler": {"type": "multijitter", "sample_count": strata},
        }
    )
