"""Depth maps of a calibrated array by plane sweep, and the points on which several views agree.

For a reference view, planes parallel to its image are swept over inverse depth; the other views' images are warped
onto each plane and compared by zero-mean normalised cross-correlation. No depth range is given: it is found by a
coarse sweep from infinity to the parallax at which the views would hardly overlap any more.

An image of -1 has no light there: its camera does not see the pixel. Windows of correlation then hold the nearest
light instead. With marks in them the edges of two fields of view would match, and all views agree on where they do.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from spike4dgs.benchmark.arrays import Float32, Float64, Int64, Mask
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.settings import Settings
from spike4dgs.method.splat.kernels.threads import get_threads


@dataclass(frozen=True)
class SweepSettings(Settings):
    """Numbers of the plane sweep (prefix `initialization`)."""

    window_px: int = 5  # side of the correlation window: small enough for thin things at 125x200
    noise: float = 4e-4  # variance of an image's noise, about (0.02 of white)^2: else flat regions match by chance
    parallax_step_px: float = 1.0  # of the widest pair between planes; peaks are refined below it
    max_parallax: float = 0.6  # of the image's width, of the widest pair: nearer things are in too few views to match
    min_score: float = 0.4  # mean correlation over the other views below which a depth is not believed
    agree_px: float = 1.5  # parallax between two views' depths of one point that still counts as agreement
    min_agree: int = 2  # other views that must agree


DEFAULTS = SweepSettings()
UNSEEN = -1.0  # in place of light, where a camera does not see the pixel


@dataclass(frozen=True, eq=False)
class DepthMap:
    """A reference view's inverse depth [H, W] in 1/m and how well the other views match there [H, W], -1 to 1."""

    inverse: Float32
    score: Float32


def widest_baseline(cameras: Sequence[Camera]) -> float:
    """Return the largest distance between two cameras, m; 0 where it is no more than their centres' rounding."""
    centers = np.stack([c.center for c in cameras])
    widest = float(np.linalg.norm(centers[:, None] - centers[None], axis=-1).max())
    return widest if widest > 1e-9 * float(np.abs(centers).max()) else 0.0


def inverse_depth_step(cameras: Sequence[Camera], parallax_px: float = 1.0) -> float:
    """Return the difference of inverse depth, 1/m, that shifts a point by so many px in the widest pair."""
    return parallax_px / (cameras[0].fx * widest_baseline(cameras))


def full_range(cameras: Sequence[Camera], settings: SweepSettings = DEFAULTS) -> Float64:
    """Return the inverse depths to sweep where nothing is known: from infinity to `max_parallax`."""
    step = inverse_depth_step(cameras, settings.parallax_step_px)
    planes = int(settings.max_parallax * cameras[0].width / settings.parallax_step_px)
    return step * np.arange(planes + 1, dtype=np.float64)


def find_range(cameras: Sequence[Camera], images: Float32, settings: SweepSettings = DEFAULTS) -> Float64:
    """Return the inverse depths at which the scene lies: a sweep of the full range at half the size, and a margin.

    Everything is kept where nothing matches.
    """
    planes, step = full_range(cameras, settings), inverse_depth_step(cameras, settings.parallax_step_px)
    half = [c.scaled(c.width // 2, c.height // 2) for c in cameras]
    light, seen = _unmarked(images)
    small = _halved(light, half[0])
    if seen is not None:
        small[_halved(seen, half[0]) <= 0.5] = UNSEEN
    maps = sweep_all(half, small, planes[::2], settings=settings)
    found = np.concatenate([m.inverse[agreed(half, maps, i, settings)] for i, m in enumerate(maps)])
    if not len(found):
        return planes
    low, high = np.quantile(found, [0.002, 0.998])
    return planes[(planes >= low - 6 * step) & (planes <= high + 6 * step)]


def _halved(images: Float32, camera: Camera) -> Float32:
    size = camera.width, camera.height
    return np.stack([np.asarray(cv2.resize(p, size, interpolation=cv2.INTER_AREA), np.float32) for p in images])


def _unmarked(images: Float32) -> tuple[Float32, Float32 | None]:
    """Return images whose marked pixels have the nearest light, and where there is some [C, H, W]; None: everywhere."""
    seen = images != UNSEEN
    if seen.all():
        return images, None
    light = images.copy()
    for image, where in zip(light, seen, strict=True):
        if where.any():
            image[:] = image[tuple(distance_transform_edt(~where, return_distances=False, return_indices=True))]
    return light, seen.astype(np.float32)


def plane_homographies(reference: Camera, other: Camera, inverse_depths: Sequence[float]) -> Iterator[Float64]:
    """Yield the homographies [3, 3] from `reference` to `other` over planes z = 1 / inverse_depth of its frame.

    x' ~ K' (R + t w n^T) K^-1 x with the relative pose (R, t), w the inverse depth and n the optical axis.
    Coordinates have pixel centres at +0.5.
    """
    R = other.R @ reference.R.T
    t = other.t - R @ reference.t
    intrinsic, back = other.K, np.linalg.inv(reference.K)
    yield from (intrinsic @ (R + np.outer(t, [0.0, 0.0, w])) @ back for w in inverse_depths)


def sweep_all(
    cameras: Sequence[Camera],
    images: Float32,
    planes: Float64,
    pixels: Sequence[Mask] | None = None,
    settings: SweepSettings = DEFAULTS,
) -> list[DepthMap]:
    """Return `sweep` of every view, with `pixels` a mask for each; views are shared out among threads."""

    def one(index: int) -> DepthMap:
        return sweep(cameras, images, index, planes, pixels[index] if pixels is not None else None, settings)

    with ThreadPoolExecutor(get_threads()) as pool:
        return list(pool.map(one, range(len(cameras))))


def sweep(
    cameras: Sequence[Camera],
    images: Float32,
    index: int,
    planes: Float64,
    pixels: Mask | None = None,
    settings: SweepSettings = DEFAULTS,
) -> DepthMap:
    """Return the depth of view `index` from all other views; images [C, H, W], inverse depths `planes` ascending.

    With a mask `pixels` [H, W] only the rectangle that holds it is swept; elsewhere the score is -1.
    """
    images, seen_pixels = _unmarked(images)
    window = settings.window_px
    top, left, bottom, right = _rectangle(pixels, window) if pixels is not None else (0, 0, *images.shape[1:])
    reference = np.ascontiguousarray(images[index, top:bottom, left:right])
    height, width = reference.shape
    mean = _box(reference, window)
    variance = _box(reference * reference, window) - mean * mean
    scores = np.zeros((len(planes), height, width), np.float32)
    here = np.array([[1, 0, left + 0.5], [0, 1, top + 0.5], [0, 0, 1.0]])  # array index to pixel coordinate
    there = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])  # and back
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    others = [i for i in range(len(cameras)) if i != index]
    maps = [plane_homographies(cameras[index], cameras[other], planes.tolist()) for other in others]
    for plane, homographies in enumerate(zip(*maps, strict=True)):
        total, seen = scores[plane], np.zeros((height, width), np.float32)
        for other, homography in zip(others, homographies, strict=True):
            H, size = there @ homography @ here, (width, height)
            if seen_pixels is None:
                warped = cv2.warpPerspective(images[other], H, size, flags=flags, borderValue=-1.0)
                inside = warped >= 0
            else:
                warped = cv2.warpPerspective(images[other], H, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
                inside = cv2.warpPerspective(seen_pixels[other], H, size, flags=flags, borderValue=0.0) > 0.5
            total += np.maximum(_correlation(reference, mean, variance, warped, settings), 0) * inside
            seen += inside
        total /= np.maximum(seen, min(2, len(others)))  # of several, a plane that a single view sees proves nothing
    found = _peak(scores, planes)
    whole = DepthMap(np.zeros(images.shape[1:], np.float32), np.full(images.shape[1:], -1, np.float32))
    whole.inverse[top:bottom, left:right], whole.score[top:bottom, left:right] = found.inverse, found.score
    return whole


def _rectangle(pixels: Mask, window: int) -> tuple[int, int, int, int]:
    """Return top, left, bottom, right of the smallest rectangle that holds a mask and a margin of one window."""
    rows, columns = np.nonzero(pixels.any(axis=1))[0], np.nonzero(pixels.any(axis=0))[0]
    if not len(rows):
        return 0, 0, 1, 1
    top, left = max(0, int(rows[0]) - window), max(0, int(columns[0]) - window)
    return top, left, int(rows[-1]) + 1 + window, int(columns[-1]) + 1 + window


def _box(image: Float32, window: int) -> Float32:
    return np.asarray(cv2.boxFilter(image, -1, (window, window), borderType=cv2.BORDER_REFLECT), np.float32)


def _correlation(a: Float32, mean_a: Float32, variance_a: Float32, b: Float32, settings: SweepSettings) -> Float32:
    window, noise = settings.window_px, settings.noise
    mean_b = _box(b, window)
    variance_b = _box(b * b, window) - mean_b * mean_b
    both = _box(a * b, window) - mean_a * mean_b
    return np.asarray(both / np.sqrt((variance_a + noise) * (variance_b + noise)), np.float32)


def _peak(scores: Float32, planes: Float64) -> DepthMap:
    """Return the best plane per pixel with a parabola through its neighbours."""
    best = scores.argmax(axis=0)
    inner = np.clip(best, 1, len(planes) - 2)

    def at(i: NDArray[np.intp]) -> Float32:
        return np.take_along_axis(scores, i[None], axis=0)[0]

    left, middle, right = at(inner - 1), at(inner), at(inner + 1)
    curvature = left - 2 * middle + right
    shift = np.where(curvature < -1e-6, 0.5 * (left - right) / np.minimum(curvature, -1e-6), 0.0)
    position = np.where(inner == best, inner + np.clip(shift, -0.5, 0.5), best)
    inverse = planes[0] + position * (planes[1] - planes[0])
    return DepthMap(inverse.astype(np.float32), at(best))


def lift(camera: Camera, inverse: Float32, pixels: Mask) -> Float64:
    """Return world points [N, 3] of the masked pixels, at their inverse depths."""
    v, u = np.nonzero(pixels)
    depth = 1 / np.maximum(inverse[v, u].astype(np.float64), 1e-9)
    return camera.unproject(np.stack([u + 0.5, v + 0.5], axis=-1), depth)


def pixels_of(camera: Camera, points: Float64) -> tuple[Mask, Int64, Int64, Float64]:
    """Return which points [N, 3] a camera sees, their pixels' columns and rows (0 for others), and their depths."""
    uv, z = camera.project(points)
    inside = (z > 0) & (uv >= 0).all(axis=1) & (uv < [camera.width, camera.height]).all(axis=1)
    u, v = np.where(inside[:, None], uv, 0).astype(np.int64).T
    return inside, u, v, z


def agreed(cameras: Sequence[Camera], maps: Sequence[DepthMap], index: int, settings: SweepSettings = DEFAULTS) -> Mask:
    """Return the pixels [H, W] of view `index` on whose depth `min_agree` other views agree, or the only other."""
    camera, own = cameras[index], maps[index]
    believed = (own.score > settings.min_score) & (own.inverse > 0)
    points = lift(camera, own.inverse, believed)
    votes = np.zeros(len(points), np.int64)
    tolerance = settings.agree_px * inverse_depth_step(cameras)
    for other, other_map in enumerate(maps):
        if other == index:
            continue
        inside, u, v, z = pixels_of(cameras[other], points)
        inverse = np.divide(1.0, z, out=np.zeros_like(z), where=z > 0)
        votes += inside & (np.abs(other_map.inverse[v, u] - inverse) < tolerance)
    believed[believed] = votes >= min(settings.min_agree, len(cameras) - 1)
    return believed
