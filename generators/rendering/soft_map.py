"""Soft light at the centres of all pixels at one time, and how samples of other times find it.

A sample goes back to where its surface point was at the map's time, along the exact motion of its face, and looks at
the pixels around it there. Those count that see a like surface: a similar normal, a tangent plane through the point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.rendering.like_surfaces import LIKE_COSINE, LIKE_PX, camera_rows
from spike4dgs.generators.rendering.mitsuba_scene import MitsubaScene, aligned

LEAST_WEIGHT = 0.02  # of like surfaces around a sample, of at most 1; below it a sample traces its path


@dataclass(frozen=True, eq=False)
class SoftMap:
    """Soft light at the centres of all pixels, at one time, in the tracer's memory."""

    planes: mi.Float  # [N * 4] unit normal, and its product with the position; 0 without a surface
    matte: mi.Float  # [N * 4] linear RGB over the albedo, and a number that nobody reads
    gloss: mi.Float  # [N * 4] linear RGB, and a number that nobody reads
    corners: mi.Float  # [V * 4] vertices of the moving surfaces then, x y z and a number that nobody reads


class SoftPoints(NamedTuple):
    """Surface points at the centres of K pixels; all [K, 3] float32."""

    points: np.ndarray
    normals: np.ndarray  # unit; 0 without a surface
    matte: np.ndarray  # soft light of the matte lobe over the albedo, linear RGB
    gloss: np.ndarray  # soft light of a coat's gloss


class Place(NamedTuple):
    """Where samples were at the time of a map."""

    share: mi.Float
    known: SoftMap
    point: mi.Vector3f
    normal: mi.Vector3f
    u: mi.Float  # column, 0 at the centre of the first pixel
    v: mi.Float
    width: mi.Float  # of a pixel, in metres


Light = tuple[mi.Color3f, mi.Color3f, mi.Float]  # weighted sums of matte light and of gloss, and the weight


@dataclass(frozen=True, eq=False)
class SoftMaps:
    """The views and the moving surfaces, with which samples find their place in a map; a tree of arrays."""

    width: mi.UInt32  # a number of the data, as in `Views`
    height: mi.UInt32
    moving: list[tuple[mi.ShapePtr, int]]  # the surfaces, and the first of `faces` of each
    faces: mi.UInt32  # [F * 4] vertices of a face, and a number that nobody reads
    cameras: mi.Float  # [C * 21] `camera_rows`
    has_lens: bool

    @staticmethod
    def of(scene: MitsubaScene, cameras: Sequence[Camera]) -> SoftMaps:
        """Return those of a scene and its cameras."""
        by_id = {shape.id(): shape for shape in scene.full.shapes()}
        faces = np.zeros((len(scene.moving_faces), 4), np.uint32)
        faces[:, :3] = scene.moving_faces
        return SoftMaps(
            dr.opaque(mi.UInt32, cameras[0].width),
            dr.opaque(mi.UInt32, cameras[0].height),
            [(mi.ShapePtr(by_id[name]), first) for name, first in scene.first_faces().items()],
            mi.UInt32(aligned(faces.ravel())),
            mi.Float(aligned(camera_rows(cameras).astype(np.float32).ravel())),
            any(c.distortion for c in cameras),
        )

    def place(
        self,
        view: mi.UInt32,
        si: mi.SurfaceInteraction3f,
        hit: mi.PreliminaryIntersection3f,
        share: mi.Float,
        known: SoftMap,
        moving: bool,
        active: mi.Bool,
    ) -> Place:
        """Return where samples were at a map's time; `share` is the map's weight."""
        point, normal = mi.Vector3f(si.p), mi.Vector3f(si.n)
        if moving:
            point, normal = self._carried(hit, point, normal, known.corners, active)
        return Place(share, known, point, normal, *self._project(view, point))

    def looked_up(self, view: mi.UInt32, places: Sequence[Place], active: mi.Bool) -> Light:
        """Return the weighted sums around each sample: bilinear, over like surfaces."""
        light = mi.Color3f(0), mi.Color3f(0), mi.Float(0)
        for place in places:
            column, row = dr.floor(place.u), dr.floor(place.v)
            for down in (0, 1):
                for right in (0, 1):
                    w = (place.u - column if right else 1 + column - place.u) * (
                        place.v - row if down else 1 + row - place.v
                    )
                    light = self._added(light, place, view, column + right, row + down, w, active)
        return light

    def _added(
        self,
        light: Light,
        place: Place,
        view: mi.UInt32,
        column: mi.Float,
        row: mi.Float,
        w: mi.Float,
        active: mi.Bool,
    ) -> Light:
        """Return the sums with a map's light in one pixel, where it sees a like surface."""
        x, y = mi.Int32(column), mi.Int32(row)
        inside = active & (x >= 0) & (y >= 0) & (x < mi.Int32(self.width)) & (y < mi.Int32(self.height))
        at = (view * self.height + mi.UInt32(y)) * self.width + mi.UInt32(x)
        plane = dr.gather(mi.Vector4f, place.known.planes, at, inside)
        normal = mi.Vector3f(plane.x, plane.y, plane.z)
        like = inside & (dr.dot(normal, place.normal) > LIKE_COSINE)
        like &= dr.abs(dr.dot(normal, place.point) - plane.w) < LIKE_PX * place.width
        w = dr.select(like, w * place.share, 0)
        matte, gloss = (dr.gather(mi.Vector4f, a, at, inside) for a in (place.known.matte, place.known.gloss))
        return (
            light[0] + w * mi.Color3f(matte.x, matte.y, matte.z),
            light[1] + w * mi.Color3f(gloss.x, gloss.y, gloss.z),
            light[2] + w,
        )

    def _carried(
        self,
        hit: mi.PreliminaryIntersection3f,
        point: mi.Vector3f,
        normal: mi.Vector3f,
        corners: mi.Float,
        active: mi.Bool,
    ) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Return the point and normal at the time of `corners`; those of static surfaces stay."""
        moves, face = mi.Bool(False), hit.prim_index
        for shape, first in self.moving:
            mine = active & (hit.shape == shape)
            moves |= mine
            face = dr.select(mine, hit.prim_index + first, face)
        numbers = [dr.gather(mi.UInt32, self.faces, 4 * face + k, moves) for k in range(3)]
        a, b, c = (dr.gather(mi.Vector4f, corners, n, moves) for n in numbers)
        a, b, c = (mi.Vector3f(p.x, p.y, p.z) for p in (a, b, c))
        u, v = hit.prim_uv.x, hit.prim_uv.y
        there = dr.fma(b - a, u, dr.fma(c - a, v, a))
        return dr.select(moves, there, point), dr.select(moves, dr.normalize(dr.cross(b - a, c - a)), normal)

    def _project(self, view: mi.UInt32, point: mi.Vector3f) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Return column and row of a point, 0 at the centre of the first pixel, and the width of a pixel there in m."""
        r = [dr.gather(mi.Float, self.cameras, view * 21 + k) for k in range(12)]
        x, y, z = (r[3 * k] * point.x + r[3 * k + 1] * point.y + r[3 * k + 2] * point.z + r[9 + k] for k in range(3))
        x, y = x / z, y / z
        if self.has_lens:
            k1, k2, p1, p2, k3 = (dr.gather(mi.Float, self.cameras, view * 21 + k) for k in range(16, 21))
            s = x * x + y * y
            radial = 1 + s * (k1 + s * (k2 + s * k3))
            x, y = (
                x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x),
                y * radial + 2 * p2 * x * y + p1 * (s + 2 * y * y),
            )
        fx, fy, cx, cy = (dr.gather(mi.Float, self.cameras, view * 21 + k) for k in range(12, 16))
        return x * fx + cx - 0.5, y * fy + cy - 0.5, z / fx


def soft_map(known: SoftPoints, corners: np.ndarray) -> SoftMap:
    """Return the map of the points of all N pixels; `corners` [V, 3]: vertices of the moving surfaces then."""
    planes = np.concatenate([known.normals, (known.points * known.normals).sum(1, keepdims=True)], 1)
    return SoftMap(*(_packed(a) for a in (planes, known.matte, known.gloss, corners)))


def _packed(values: np.ndarray) -> mi.Float:
    """Return rows [N, up to 4] as one buffer of four floats a row."""
    rows = np.zeros((max(len(values), 1), 4), np.float32)
    rows[: len(values), : values.shape[1] if len(values) else 0] = values
    return mi.Float(aligned(rows.ravel()))
