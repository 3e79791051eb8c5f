"""Procedural triangle meshes. Z is up; texture coordinates have v = 0 at the top row of the image.

Every surface is shaded on both sides, so winding only has to be consistent within one mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Mesh:
    """Triangles: vertices [N, 3] float64 metres, faces [M, 3] int64, uv [N, 2]; smooth = interpolate normals."""

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    smooth: bool = True

    def moved(self, matrix: np.ndarray) -> Mesh:
        """Return the mesh transformed by a [4, 4] affine matrix."""
        return replace(self, vertices=self.vertices @ matrix[:3, :3].T + matrix[:3, 3])

    def at(self, x: float, y: float, z: float) -> Mesh:
        """Return the mesh shifted by (x, y, z)."""
        return self.moved(translation(x, y, z))


# ---------------------------------------------------------------- affine maps


def translation(x: float, y: float, z: float) -> np.ndarray:
    """Return the [4, 4] translation."""
    m = np.eye(4)
    m[:3, 3] = x, y, z
    return m


def rotation(axis: str, angle_rad: float) -> np.ndarray:
    """Return the [4, 4] right-handed rotation about the axis "x", "y" or "z"."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    m = np.eye(4)
    m[i, i] = m[j, j] = np.cos(angle_rad)
    m[j, i] = np.sin(angle_rad)
    m[i, j] = -m[j, i]
    return m


def scaling(x: float, y: float, z: float) -> np.ndarray:
    """Return the [4, 4] scaling."""
    return np.diag([x, y, z, 1.0])


# ---------------------------------------------------------------- building blocks


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Return several meshes as one (they keep their own texture coordinates)."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=True)]),
        np.concatenate([m.uv for m in meshes]),
        meshes[0].smooth,
    )


def quad(
    center: Sequence[float], right: Sequence[float], up: Sequence[float], uv_size: Sequence[float] = (1, 1)
) -> Mesh:
    """Return a parallelogram: `right` and `up` are its full edge vectors; an image on it is upright along `up`."""
    c, r, u = (np.asarray(a, np.float64) for a in (center, right, up))
    corners = np.array([c - r / 2 - u / 2, c + r / 2 - u / 2, c + r / 2 + u / 2, c - r / 2 + u / 2])
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float64) * np.asarray(uv_size, np.float64)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), uv, smooth=False)


def box(
    size: Sequence[float], center: Sequence[float] = (0, 0, 0), uv_per_m: float | None = None, bottom: bool = True
) -> Mesh:
    """Return a box whose faces each carry the whole image upright, or `uv_per_m` repeats per metre."""
    sx, sy, sz = size
    # (outward direction, image's right edge, image's up edge): right x up = outward, so text reads from outside
    faces = [
        ((0, -1, 0), (sx, 0, 0), (0, 0, sz)),
        ((0, 1, 0), (-sx, 0, 0), (0, 0, sz)),
        ((1, 0, 0), (0, sy, 0), (0, 0, sz)),
        ((-1, 0, 0), (0, -sy, 0), (0, 0, sz)),
        ((0, 0, 1), (sx, 0, 0), (0, sy, 0)),
        ((0, 0, -1), (sx, 0, 0), (0, -sy, 0)),
    ]
    half, quads = np.asarray(size, np.float64) / 2, []
    for outward, right, up in faces if bottom else faces[:-1]:
        middle = np.asarray(center, np.float64) + np.asarray(outward) * half
        uv = (1, 1) if uv_per_m is None else (np.linalg.norm(right) * uv_per_m, np.linalg.norm(up) * uv_per_m)
        quads.append(quad(middle, right, up, uv))
    return merge(quads)


def surface(points: np.ndarray, smooth: bool = True) -> Mesh:
    """Return a grid of points [n, m, 3] as a surface; u runs along the first index, v along the second."""
    n, m = points.shape[:2]
    i, j = np.meshgrid(np.arange(n - 1), np.arange(m - 1), indexing="ij")
    a = (i * m + j).ravel()
    faces = np.concatenate([np.stack([a, a + m, a + m + 1], 1), np.stack([a, a + m + 1, a + 1], 1)])
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, m), indexing="ij")
    return Mesh(points.reshape(-1, 3).astype(np.float64), faces, np.stack([u.ravel(), v.ravel()], 1), smooth)


def fan(ring: np.ndarray) -> Mesh:
    """Return a flat cap over a convex closed ring [n, 3]."""
    n = len(ring)
    i = np.arange(n)
    vertices = np.concatenate([ring, ring.mean(0, keepdims=True)])
    return Mesh(vertices, np.stack([i, (i + 1) % n, np.full(n, n)], 1), np.full((n + 1, 2), 0.5), smooth=False)


def loft(rings: np.ndarray, caps: bool = True) -> Mesh:
    """Return a skin over closed rings [n, m, 3]."""
    closed = np.concatenate([rings, rings[:, :1]], 1)
    skin = surface(closed)
    return merge([skin, fan(rings[0]), fan(rings[-1][::-1])]) if caps else skin


def skin(stations: Sequence[Sequence[float]], count: int, ring: np.ndarray) -> Mesh:
    """Return a loft along x over `count` interpolated stations (x, height of the middle, half height, half width).

    `ring` [m, 2] is the cross-section in half widths (y) and half heights (z).
    """
    given = np.asarray(stations)
    x = np.linspace(given[0, 0], given[-1, 0], count)
    rows = [np.interp(x, given[:, 0], given[:, k]) for k in (1, 2, 3)]
    y, z = ring.T
    return loft(np.stack([np.stack([0 * y + xi, w * y, m + h * z], 1) for xi, m, h, w in zip(x, *rows, strict=True)]))


def revolve(profile: np.ndarray, segments: int = 48, axis: str = "z") -> Mesh:
    """Return the surface of a profile [m, 2] (radius, offset along the axis) turned about "z" or "y"; u runs around."""
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    radius, offset = np.asarray(profile, np.float64).T
    a, b = np.cos(angle)[:, None] * radius, np.sin(angle)[:, None] * radius
    h = np.broadcast_to(offset, a.shape)
    return surface(np.stack([a, b, h] if axis == "z" else [b, h, a], -1))


def tube(path: Sequence[Sequence[float]], radius: float | Sequence[float], sides: int = 10) -> Mesh:
    """Return a round tube along a polyline; one radius, or one per point."""
    p = np.asarray(path, np.float64)
    r = np.broadcast_to(np.asarray(radius, np.float64), (len(p),))
    tangent = np.gradient(p, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    helper = np.eye(3)[np.argmin(np.abs(tangent).max(0))]  # the axis to which no part of the line is nearly parallel
    n = np.cross(tangent, helper)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    b = np.cross(tangent, n)
    a = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    around = np.cos(a)[:, None, None] * n + np.sin(a)[:, None, None] * b  # [sides, points, 3]
    return loft((p + r[:, None] * around).swapaxes(0, 1))


def disc(radius: float, height: float = 0.0, segments: int = 96) -> Mesh:
    """Return a horizontal disc facing up; the image's inscribed circle lies on it, its top towards +Y."""
    a = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    ring = np.stack([radius * np.cos(a), radius * np.sin(a), np.full(segments, height)], 1)
    cap = fan(ring)
    return replace(
        cap, uv=np.stack([0.5 + 0.5 * cap.vertices[:, 0] / radius, 0.5 - 0.5 * cap.vertices[:, 1] / radius], 1)
    )


def ellipsoid(radii: Sequence[float], center: Sequence[float] = (0, 0, 0), segments: int = 24) -> Mesh:
    """Return an ellipsoid with radii (x, y, z)."""
    theta = np.linspace(0, np.pi, segments // 2 + 1)
    ball = revolve(np.stack([np.sin(theta), np.cos(theta)], 1), segments)
    return ball.moved(translation(*center) @ scaling(*radii))


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Return area-weighted normals [N, 3], shared by vertices at equal positions so that texture seams do not show."""
    corners = mesh.vertices[mesh.faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    _, same = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)
    same = same.ravel()
    total = np.zeros((same.max() + 1, 3))
    for k in range(3):
        np.add.at(total, same[mesh.faces[:, k]], face)
    normal = total[same]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.where(length > 1e-12, normal / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])


# ---------------------------------------------------------------- box-projected images


@dataclass(frozen=True)
class Atlas:
    """Five flat images in one texture, projected on a body along -y, +y, z, +x and -x.

    `length`, `width`, `height` are the body's extents in metres: x in +-length/2, y in +-width/2, z in 0..height.
    The images lie below each other: near side, far side, top, then front and back next to each other.
    """

    length: float
    width: float
    height: float
    texels_per_m: float

    @property
    def shape(self) -> tuple[int, int]:
        """Texture size (rows, columns)."""
        rows = 3 * self.height + self.width
        return round(rows * self.texels_per_m), round(max(self.length, 2 * self.width) * self.texels_per_m)

    def project(self, chart: str, p: np.ndarray) -> np.ndarray:
        """Map points [N, 3] on the body to texture metres [N, 2] (right, down); chart near|far|top|front|back."""
        x, y, z = np.asarray(p, np.float64).T
        across, h = self.length / 2, self.height
        if chart == "near":
            return np.stack([across + x, h - z], 1)
        if chart == "far":
            return np.stack([across - x, 2 * h - z], 1)
        if chart == "top":
            return np.stack([across + x, 2 * h + self.width / 2 - y], 1)
        if chart == "front":
            return np.stack([self.width / 2 + y, 3 * h + self.width - z], 1)
        return np.stack([1.5 * self.width - y, 3 * h + self.width - z], 1)

    def at(self, chart: str, points: Sequence[Sequence[float]]) -> np.ndarray:
        """Map points [N, 2] of the two coordinates that a chart shows: x, z; on top x, y; in front and back y, z."""
        seen = {"top": [0, 1], "front": [1, 2], "back": [1, 2]}.get(chart, [0, 2])
        p = np.zeros((len(points), 3))
        p[:, seen] = points
        return self.project(chart, p)

    def wrap(self, mesh: Mesh) -> Mesh:
        """Return the mesh cut along chart borders, with uv into this atlas.

        A vertex that several charts need is doubled; `vertex_normals` merges equal positions again, so the cuts do not
        show in the shading. Each face goes to the chart that it faces, away from the middle of the body.
        """
        corners = mesh.vertices[mesh.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        away = corners.mean(1) - mesh.vertices.mean(0)
        normal *= np.where((normal * away).sum(1, keepdims=True) < 0, -1, 1)
        axis = np.abs(normal).argmax(1)
        side = np.where(normal[:, 1] < 0, 0, 1)
        chart = np.where(axis == 1, side, np.where(axis == 2, 2, np.where(normal[:, 0] > 0, 3, 4)))
        size = np.array(self.shape[::-1]) / self.texels_per_m
        pieces = []
        for k, name in enumerate(("near", "far", "top", "front", "back")):
            faces = mesh.faces[chart == k]
            if len(faces):
                used, compact = np.unique(faces, return_inverse=True)
                points = mesh.vertices[used]
                pieces.append(Mesh(points, compact.reshape(-1, 3), self.project(name, points) / size, mesh.smooth))
        return merge(pieces)
