"""The same tracing interface with Mitsuba's scalar variants: slower, needs no libLLVM.

Python cannot call the scalar integrator per sample (a call costs more than a path), so pixels are rendered in fixed
square tiles by `mi.render`. A tile's seed depends on (seed, camera, tile, stream), never on what else is traced.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from spike4dgs.benchmark.cameras import Camera, mitsuba_sensor, mitsuba_to_world
from spike4dgs.generators.mitsuba_scene import MitsubaScene

_TILE = 16
_LUMINANCE = np.array([0.212671, 0.715160, 0.072169], np.float32)  # Mitsuba's `luminance` of linear Rec. 709


class TileTracer:
    """Traces pixels of several views. Pixels are flat numbers: (view * height + row) * width + column."""

    def __init__(self, scene: MitsubaScene, cameras: Sequence[Camera], seed: int, max_depth: int) -> None:
        self._scene, self._cameras, self._seed = scene, cameras, seed
        self._width, self._height = cameras[0].width, cameras[0].height
        # blocks smaller than a tile, so that all cores work on one tile
        self._integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "block_size": _TILE // 2})
        self._sensors: dict[tuple[int, int, int, int], Any] = {}

    def trace(self, pixels: np.ndarray, spp: int, stream: int, moving: bool) -> np.ndarray:
        """Gray radiance [K] float32 of flat `pixels` [K], mean of `spp` samples.

        A pixel's samples are a function of (seed, camera id, row, column, spp, stream) alone.
        """
        view, inside = np.divmod(pixels, self._width * self._height)
        row, column = np.divmod(inside, self._width)
        tiles = np.stack([view, row // _TILE, column // _TILE], 1)
        wanted, which = np.unique(tiles, axis=0, return_inverse=True)
        which = which.ravel()
        out = np.zeros(len(pixels), np.float32)
        for k, (v, y, x) in enumerate(wanted.tolist()):
            mine = which == k
            gray = self._tile(v, y, x, spp, stream, moving)
            out[mine] = gray[row[mine] - y * _TILE, column[mine] - x * _TILE]
        return out

    def _tile(self, view: int, y: int, x: int, spp: int, stream: int, moving: bool) -> np.ndarray:
        key = (view, y, x, spp)
        if key not in self._sensors:
            self._sensors[key] = self._sensor(*key)
        scene = self._scene.full if moving else self._scene.empty
        name = f"{self._seed} {self._cameras[view].id} {y} {x} {stream}"
        picture = mi.render(
            scene, sensor=self._sensors[key], integrator=self._integrator, seed=zlib.crc32(name.encode())
        )
        return np.asarray(picture, np.float32)[..., :3] @ _LUMINANCE

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

    def cast(self, origins: np.ndarray, directions: np.ndarray, moving: bool) -> tuple[np.ndarray, np.ndarray]:
        """First hits of rays [N, 3]: distance along `directions` [N] float32 (inf: none), whether on an instance."""
        scene = self._scene.full if moving else self._scene.empty
        distance, on_instance = np.full(len(origins), np.inf, np.float32), np.zeros(len(origins), bool)
        for k, (o, d) in enumerate(zip(origins.tolist(), directions.tolist(), strict=True)):
            hit = scene.ray_intersect_preliminary(mi.Ray3f(o, d))
            if hit.is_valid():
                distance[k], on_instance[k] = hit.t, hit.instance is not None
        return distance, on_instance


def load_sensor(camera: Camera, film: dict[str, Any], spp: int) -> Any:
    """A Mitsuba sensor for `camera` with a box-filtered linear film, whole or cropped; at least `spp` samples."""
    rows = math.isqrt(spp)
    strata = rows * -(-spp // rows)  # Mitsuba would take as many itself, with a warning for every sensor
    return mi.load_dict(
        {
            "type": "perspective",
            **mitsuba_sensor(camera),
            "near_clip": 0.01,
            "far_clip": 1e4,
            "to_world": mi.ScalarTransform4f(mitsuba_to_world(camera)),
            "film": {"pixel_format": "rgb", "component_format": "float32", "rfilter": {"type": "box"}, **film},
            "sampler": {"type": "multijitter", "sample_count": strata},
        }
    )
