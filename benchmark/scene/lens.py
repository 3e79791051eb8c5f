"""Lens distortion by OpenCV's model of five numbers (k1, k2, p1, p2, k3), and the resampling of images.

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p2 x y + p1 (r^2 + 2 y^2),        r^2 = x^2 + y^2

x and y are normalised image coordinates of the pinhole (pixel = focal length x + principal point), x' and y' those of
the lens. Beyond the radius at which r' stops to grow, the fold, the formula would lead back into the image: there is no
image there, and coordinates are NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64, Mask

T = TypeVar("T", bound=np.generic)
Distortion = tuple[float, ...]  # k1, k2, p1, p2, k3; empty: a pinhole

NAMES = ("k1", "k2", "p1", "p2", "k3")
_MOST_STEPS = 50  # of Newton's method; 4 to 8 are usual, more are needed near the fold
_NOTHING = 1e-12  # smaller coefficients do nothing within any lens, and roots of such polynomials overflow
_TABLE = 1000  # radii of the first guess
_CONVERGED = 1e-13  # of normalised coordinates


def make_distortion(values: Sequence[float]) -> Distortion:
    """Return up to five coefficients as five; none where all are 0.

    >>> make_distortion([-0.1, 0.02])
    (-0.1, 0.02, 0.0, 0.0, 0.0)
    >>> make_distortion([0.0, 0.0, 0.0, 0.0])
    ()
    """
    if len(values) > len(NAMES):
        raise ValueError(f"{len(values)} coefficients of a lens")
    numbers = [float(v) for v in values]
    return (*numbers, *[0.0] * (len(NAMES) - len(numbers))) if any(numbers) else ()


@lru_cache(maxsize=256)
def fold_radius(lens: Distortion) -> float:
    """Return the radius of a pinhole's image at which the distorted radius is largest; infinite where it only grows.

    The tangential coefficients are left out.
    """
    k1, k2, _, _, k3 = (k if abs(k) > _NOTHING else 0.0 for k in lens)
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])  # of d(r (1 + k1 s + k2 s^2 + k3 s^3)) / dr, in s = r^2
    squares = [r.real for r in roots if abs(r.imag) < 1e-9 * max(1.0, abs(r)) and r.real > 0]
    return float(np.sqrt(min(squares))) if squares else float("inf")


def distort(xy: Float64, lens: Distortion) -> Float64:
    """Return the lens's coordinates [..., 2] of a pinhole's [..., 2]; NaN beyond the fold."""
    x, y = xy[..., 0], xy[..., 1]
    with np.errstate(over="ignore", invalid="ignore"):
        bent = np.stack(bend(x, y, lens), axis=-1)
        s = x * x + y * y
    return np.where((s < fold_radius(lens) ** 2)[..., None], bent, np.nan)


# The three below are arithmetic alone: on arrays, on tensors, and on numbers in kernels that are compiled.


def bend(x: Any, y: Any, lens: Any) -> tuple[Any, Any]:
    """Return x', y' of the module's text, beyond the fold too. `lens`: the five coefficients."""
    k1, k2, p1, p2, k3 = lens
    s = x * x + y * y
    radial = 1 + s * (k1 + s * (k2 + s * k3))
    return x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + 2 * p2 * x * y + p1 * (s + 2 * y * y)


def slopes(x: Any, y: Any, lens: Any) -> tuple[Any, Any, Any]:
    """Return the derivatives of `bend`: dx'/dx, dx'/dy = dy'/dx, dy'/dy."""
    k1, k2, p1, p2, k3 = lens
    s = x * x + y * y
    radial = 1 + s * (k1 + s * (k2 + s * k3))
    slope = 2 * (k1 + s * (2 * k2 + s * 3 * k3))  # d radial / dx = slope x
    xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
    yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    return xx, xy, yy


def curvatures(x: Any, y: Any, lens: Any) -> tuple[Any, Any, Any, Any]:
    """Return the derivatives of `slopes`: d xx/dx, d xx/dy = d xy/dx, d xy/dy = d yy/dx, d yy/dy."""
    k1, k2, p1, p2, k3 = lens
    s = x * x + y * y
    slope = 2 * (k1 + s * (2 * k2 + s * 3 * k3))
    bow = 8 * (k2 + 3 * s * k3)  # d slope / dx = bow x
    xxx = 3 * slope * x + bow * x * x * x + 6 * p2
    xxy = slope * y + bow * x * x * y + 2 * p1
    xyy = slope * x + bow * x * y * y + 2 * p2
    yyy = 3 * slope * y + bow * y * y * y + 6 * p1
    return xxx, xxy, xyy, yyy


def undistort(xy: Float64, lens: Distortion) -> Float64:
    """Return the pinhole's coordinates [..., 2] of the lens's [..., 2], by Newton's method; NaN where it has none."""
    wanted = np.asarray(xy, np.float64)
    limit = fold_radius(lens) * (1 - 1e-9)
    found = _first_guess(wanted, lens, limit)
    with np.errstate(all="ignore"):
        for _ in range(_MOST_STEPS):
            missing = wanted - distort(found, lens)
            step = _newton_step(found, missing, lens)
            found = _within(found + step, limit)
            if not np.nanmax(np.abs(step), initial=0.0) > _CONVERGED:
                break
        missing = np.abs(wanted - distort(found, lens)).max(axis=-1, keepdims=True)
    return np.where(missing < 1e-9, found, np.nan)


def _first_guess(wanted: Float64, lens: Distortion, limit: float) -> Float64:
    """Return the coordinates by a table of radii, without the tangential coefficients."""
    k1, k2, _, _, k3 = lens
    radius = np.linalg.norm(wanted, axis=-1)
    radii = np.linspace(0, min(limit, 4 * float(np.nanmax(radius, initial=0.1))), _TABLE)
    s = radii * radii
    bent = radii * (1 + s * (k1 + s * (k2 + s * k3)))
    return np.asarray(wanted * (np.interp(radius, bent, radii) / np.maximum(radius, 1e-300))[..., None])


def _within(xy: Float64, limit: float) -> Float64:
    """Return points, those beyond a radius brought back onto it."""
    if not np.isfinite(limit):
        return xy
    radius = np.linalg.norm(xy, axis=-1, keepdims=True)
    return np.where(radius > limit, xy * (limit / np.maximum(radius, 1e-300)), xy)


def _newton_step(xy: Float64, missing: Float64, lens: Distortion) -> Float64:
    """Return J^-1 missing [..., 2] with the derivatives J of `distort`, which are symmetric."""
    xx, xy_, yy = slopes(xy[..., 0], xy[..., 1], lens)
    a, b = missing[..., 0], missing[..., 1]
    return np.asarray(np.stack([yy * a - xy_ * b, xx * b - xy_ * a], axis=-1) / (xx * yy - xy_ * xy_)[..., None])


def inside(at: Float64, width: int, height: int) -> Mask:
    """Return which positions [..., 2] px lie within an image."""
    return np.asarray((at >= 0).all(-1) & (at[..., 0] <= width) & (at[..., 1] <= height))


def resample(image: Float32, at: Float64) -> Float32:
    """Return the values [h, w] of an image [H, W] at positions [h, w, 2] px, pixel centres at +0.5, by cubic splines.

    Beyond the image its border is repeated. A value is NaN where most of what lies around it is NaN; elsewhere such
    pixels are filled from their neighbours first.
    """
    from scipy.ndimage import map_coordinates  # it takes longer to import than what opens scenes

    known = np.isfinite(image)
    if not known.any():
        return np.full(at.shape[:2], np.nan, np.float32)
    filled = image if known.all() else _filled(image, known)
    where = np.nan_to_num(at - 0.5, nan=-1.0).transpose(2, 0, 1)[::-1]
    # Linear interpolation loses 2 dB here, on images of 200x125 pixels.
    found = map_coordinates(filled, where, order=3, mode="nearest").clip(filled.min(), filled.max())
    if filled is not image:
        found[map_coordinates(known.astype(np.float32), where, order=1, mode="nearest") < 0.5] = np.nan
    return np.asarray(found, np.float32)


def _filled(image: Float32, known: Mask) -> Float32:
    """Return an image without NaN: unknown pixels get the mean of the known ones around, or of all."""
    from scipy.ndimage import uniform_filter

    weight = uniform_filter(known.astype(np.float64), 5)
    mean = uniform_filter(np.where(known, image, 0.0).astype(np.float64), 5)
    around = np.where(weight > 0.01, mean / np.maximum(weight, 0.01), image[known].mean())
    return np.where(known, image, around).astype(np.float32)


def nearest(image: NDArray[T], at: Float64) -> NDArray[T]:
    """Return the pixels [..., h, w] of [..., H, W] that positions [h, w, 2] px lie in, the border's beyond it."""
    height, width = image.shape[-2:]
    column, row = (np.floor(np.nan_to_num(at[..., i], nan=-1.0)).astype(np.int64) for i in (0, 1))
    return image[..., row.clip(0, height - 1), column.clip(0, width - 1)]
