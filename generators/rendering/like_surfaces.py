"""Means over pixels that see like surfaces, nearly one plane and nearly one normal, in one view or in all.

What a surface point looks like depends on the view; the light that falls on it does not. All views that see the point
share their samples of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.spikes.bits import in_threads, kernel
from spike4dgs.generators.rendering.render import SoftStatic

LIKE_COSINE = 0.85  # between the normals of points that share soft light
LIKE_PX = 0.7  # distance of a point from the other's tangent plane, in widths of a pixel
RADIUS_PX = 3
LEAST_EXPONENT = -5.0  # of a weight in `shared`: what follows is less than a percent of the nearest
FARTHEST = 2.0  # distance of a point in another view, in widths of a pixel: grazing views see it with much around it


class Surfaces(NamedTuple):
    """What the centres of all pixels see."""

    labels: np.ndarray  # [C, H, W] int8; surfaces of two labels share nothing
    points: np.ndarray  # [C, H, W, 3] float32, positions
    normals: np.ndarray  # [C, H, W, 3] float32, unit; 0 without a surface
    widths: np.ndarray  # [C, H, W] float32, of a pixel at the point, in metres

    def places(self, pixels: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
        """Return what `places_in` has of the points of flat pixels [K]."""
        return places_in(self.points.reshape(-1, 3)[pixels], cameras)


def pixel_widths(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the width [C, H, W] float32 in metres of a pixel at surface points [C, H, W, 3]."""
    depths = [np.abs(p @ c.R[2] + c.t[2]) / c.fx for p, c in zip(points, cameras, strict=True)]
    return np.stack(depths).astype(np.float32)


def places_in(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return column and row [K, C, 2] float32, 0 at the centre of the first pixel, of points [K, 3] in all views.

    NaN where a point is behind a camera. Beyond the fold of a lens places are wrong: no like surface is seen there.
    """
    out = np.full((len(points), len(cameras), 2), np.nan, np.float32)
    in_threads(_places, len(points), points.astype(np.float64), camera_rows(cameras), out, small=len(points) < 1000)
    return out


def camera_rows(cameras: Sequence[Camera]) -> np.ndarray:
    """Return [C, 21] float64: rotation and translation into each camera, fx, fy, cx, cy, and its lens."""
    return np.array([[*c.R.ravel(), *c.t, c.fx, c.fy, c.cx, c.cy, *(c.distortion or (0.0,) * 5)] for c in cameras])


def coverage(pixels: np.ndarray, paths: np.ndarray, surfaces: Surfaces, places: np.ndarray) -> np.ndarray:
    """Return the number [K] int32 of views that see the surface point of each flat pixel within a pixel's width.

    Its own view counts. In another, the pixel nearest to the point has to have samples (`paths` [C, H, W] > 0), the
    same label, and a like surface. The arguments are those of `shared`.
    """
    out = np.ones(len(pixels), np.int32)
    in_threads(_coverage, len(pixels), pixels, paths, *surfaces, places, out, small=len(pixels) < 1000)
    return out


def shared(
    pixels: np.ndarray,
    values: np.ndarray,
    paths: np.ndarray,
    surfaces: Surfaces,
    places: np.ndarray,
    sigma_px: float,
) -> np.ndarray:
    """Return weighted means [K, D] float32 of `values` around flat `pixels` [K], on like surfaces in all views.

    In its own view a pixel takes from those within RADIUS_PX with its label, a normal within LIKE_COSINE of its own and
    a point near its tangent plane; in another view from those around its surface point's place, if their points are
    also within FARTHEST widths of a pixel of it. Weights are `paths` times a Gaussian of the distance in px, cut.

    Args:
        pixels: flat numbers of the pixels.
        values: [C, H, W, D].
        paths: [C, H, W] int32, the samples of each value; 0 for none.
        surfaces: of all pixels.
        places: [K, C, 2] from `places_in`, of the pixels' points; NaN leaves a view out.
        sigma_px: of the Gaussian weights.
    """
    out = np.zeros((len(pixels), values.shape[-1]), np.float32)
    in_threads(_shared, len(pixels), pixels, values, paths, *surfaces, places, sigma_px, out, small=len(pixels) < 1000)
    return out


def join_soft(parts: Sequence[tuple[np.ndarray, ...]], cameras: Sequence[Camera], sigma_px: float) -> SoftStatic:
    """Return the background's map of the results of `SplitRenderer.soft_at` for all pixels in order."""
    shape = len(cameras), cameras[0].height, cameras[0].width
    points, normals, paths, first = (np.concatenate(p).reshape(*shape, -1) for p in zip(*parts, strict=True))
    paths, every = paths[..., 0], np.arange(paths[..., 0].size)
    surfaces = Surfaces(np.zeros(shape, np.int8), points, normals, pixel_widths(points, cameras))
    smooth = smoothed_light(every, first, paths, surfaces, surfaces.places(every, cameras), sigma_px)
    return SoftStatic(points, normals, paths, first, smooth.reshape(first.shape))


def smoothed_light(
    where: np.ndarray, light: np.ndarray, paths: np.ndarray, surfaces: Surfaces, places: np.ndarray, sigma_px: float
) -> np.ndarray:
    """Return soft light [K, 6] at flat pixels: matte light is a mean over all views, gloss over one.

    `light` is [C, H, W, 6]; the other arguments are those of `shared`.
    """
    matte, gloss = (np.ascontiguousarray(light[..., part]) for part in (slice(3), slice(3, 6)))
    nowhere = np.full_like(places, np.nan)
    return np.concatenate(
        [
            shared(where, matte, paths, surfaces, places, sigma_px),
            shared(where, gloss, np.minimum(paths, 1), surfaces, nowhere, sigma_px),
        ],
        1,
    )


@kernel
def _places(points: Any, cameras: Any, out: Any, start: int, stop: int) -> None:
    for k in range(start, stop):
        for view in range(len(cameras)):
            c = cameras[view]
            x, y, z = (
                c[0] * points[k, 0] + c[1] * points[k, 1] + c[2] * points[k, 2] + c[9],
                c[3] * points[k, 0] + c[4] * points[k, 1] + c[5] * points[k, 2] + c[10],
                c[6] * points[k, 0] + c[7] * points[k, 1] + c[8] * points[k, 2] + c[11],
            )
            if z <= 0:
                continue
            x, y = x / z, y / z
            s = x * x + y * y
            radial = 1 + s * (c[16] + s * (c[17] + s * c[20]))
            u = x * radial + 2 * c[18] * x * y + c[19] * (s + 2 * x * x)
            v = y * radial + 2 * c[19] * x * y + c[18] * (s + 2 * y * y)
            out[k, view, 0], out[k, view, 1] = c[12] * u + c[14] - 0.5, c[13] * v + c[15] - 0.5


@kernel
def _apart(normal: Any, point: Any, normals: Any, points: Any, view: int, y: int, x: int, far: float) -> float:
    """Return the squared distance of a pixel's point, or -1 where the surface is no like one."""
    cosine, off, square = 0.0, 0.0, 0.0
    for i in range(3):
        d = points[view, y, x, i] - point[i]
        cosine += normal[i] * normals[view, y, x, i]
        off += normal[i] * d
        square += d * d
    return -1.0 if cosine < LIKE_COSINE or abs(off) > far else square


@kernel
def _coverage(
    pixels: Any,
    paths: Any,
    labels: Any,
    points: Any,
    normals: Any,
    widths: Any,
    places: Any,
    out: Any,
    start: int,
    stop: int,
) -> None:
    views, height, width = labels.shape
    area = height * width
    for k in range(start, stop):
        own, inside = pixels[k] // area, pixels[k] % area
        row, column = inside // width, inside % width
        normal, point = normals[own, row, column], points[own, row, column]
        wide = widths[own, row, column]
        for view in range(views):
            u, v = places[k, view]
            if view == own or not (u >= -0.5 and v >= -0.5 and u < width - 0.5 and v < height - 0.5):
                continue
            x, y = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
            if paths[view, y, x] == 0 or labels[view, y, x] != labels[own, row, column]:
                continue
            square = _apart(normal, point, normals, points, view, y, x, LIKE_PX * wide)
            if 0 <= square <= wide * wide:
                out[k] += 1


@kernel
def _shared(
    pixels: Any,
    values: Any,
    paths: Any,
    labels: Any,
    points: Any,
    normals: Any,
    widths: Any,
    places: Any,
    sigma: float,
    out: Any,
    start: int,
    stop: int,
) -> None:
    views, height, width = labels.shape
    area, count = height * width, out.shape[1]
    for k in range(start, stop):
        own, inside = pixels[k] // area, pixels[k] % area
        row, column = inside // width, inside % width
        normal, point = normals[own, row, column], points[own, row, column]
        wide = widths[own, row, column]
        total, weight = np.zeros(count), 0.0
        for view in range(views):
            u, v = places[k, view]
            if view == own:
                u, v = column, row
            if not (u > -RADIUS_PX and v > -RADIUS_PX and u < width + RADIUS_PX and v < height + RADIUS_PX):
                continue
            for y in range(max(int(np.ceil(v - RADIUS_PX)), 0), min(int(np.floor(v + RADIUS_PX)) + 1, height)):
                for x in range(max(int(np.ceil(u - RADIUS_PX)), 0), min(int(np.floor(u + RADIUS_PX)) + 1, width)):
                    if paths[view, y, x] == 0 or labels[view, y, x] != labels[own, row, column]:
                        continue
                    exponent = -0.5 * ((y - v) ** 2 + (x - u) ** 2) / sigma**2
                    itself = view == own and y == row and x == column
                    if exponent < LEAST_EXPONENT and not itself:
                        continue
                    square = _apart(normal, point, normals, points, view, y, x, LIKE_PX * wide)
                    far = square < 0 or (view != own and square > (FARTHEST * wide) ** 2)
                    if far and not itself:
                        continue
                    w = np.exp(exponent) * paths[view, y, x]
                    weight += w
                    for i in range(count):
                        total[i] += w * values[view, y, x, i]
        for i in range(count):
            out[k, i] = total[i] / weight
