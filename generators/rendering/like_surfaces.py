"""Smoothing over pixels that see like surfaces: nearly one plane, nearly one normal."""

from __future__ import annotations

from typing import Any

import numpy as np

from spike4dgs.benchmark.spikes.bits import in_threads, kernel

LIKE_COSINE = 0.85  # between the normals of points that share soft light
LIKE_PX = 0.7  # distance of a point from the other's tangent plane, in widths of a pixel
RADIUS_PX = 3


def smoothed(
    pixels: np.ndarray,
    values: np.ndarray,
    labels: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    widths: np.ndarray,
    sigma_px: float,
) -> np.ndarray:
    """Return the weighted means [K, D] float32 of `values` around the flat `pixels` [K], over like surfaces alone.

    A pixel takes from those within RADIUS_PX in its view that have its label, a normal within LIKE_COSINE of its own,
    and a point near its tangent plane.

    Args:
        pixels: flat numbers of the pixels to smooth.
        values: [C, H, W, D].
        labels: [C, H, W] int8.
        points: [C, H, W, 3] positions of the surface points.
        normals: [C, H, W, 3], unit.
        widths: [C, H, W], width of a pixel at the point in metres.
        sigma_px: of the Gaussian weights.
    """
    out = np.zeros((len(pixels), values.shape[-1]), np.float32)
    arrays = pixels, values, labels, points, normals, widths
    in_threads(_smooth, len(pixels), *arrays, sigma_px, out, small=len(pixels) < 1000)
    return out


@kernel
def _smooth(
    pixels: Any,
    values: Any,
    labels: Any,
    points: Any,
    normals: Any,
    widths: Any,
    sigma: float,
    out: Any,
    start: int,
    stop: int,
) -> None:
    _, height, width = labels.shape
    area = height * width
    for k in range(start, stop):
        view, inside = pixels[k] // area, pixels[k] % area
        row, column = inside // width, inside % width
        normal, point = normals[view, row, column], points[view, row, column]
        far = LIKE_PX * widths[view, row, column]
        total, weight = np.zeros(out.shape[1]), 0.0
        for y in range(max(row - RADIUS_PX, 0), min(row + RADIUS_PX + 1, height)):
            for x in range(max(column - RADIUS_PX, 0), min(column + RADIUS_PX + 1, width)):
                if labels[view, y, x] != labels[view, row, column]:
                    continue
                cosine, off = 0.0, 0.0
                for i in range(3):
                    cosine += normal[i] * normals[view, y, x, i]
                    off += normal[i] * (points[view, y, x, i] - point[i])
                if (cosine < LIKE_COSINE or abs(off) > far) and not (y == row and x == column):
                    continue
                w = np.exp(-0.5 * ((y - row) ** 2 + (x - column) ** 2) / sigma**2)
                weight += w
                for i in range(out.shape[1]):
                    total[i] += w * values[view, y, x, i]
        for i in range(out.shape[1]):
            out[k, i] = total[i] / weight
