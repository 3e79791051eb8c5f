"""The no-reference metrics' features once more, slow and from the definitions, and images to try them on.

Nothing here is separable, vectorised over blocks or looked up: a full 7x7 window added tap by tap, shifts by np.roll,
and a search of the whole grid of shapes.
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import gamma

Array = NDArray[np.float64]
SHAPES = np.linspace(0.2, 10, 9801)
SHIFTS = ((0, 1), (1, 0), (1, 1), (-1, 1))


def mscn(image: Array, border: str, flat: float = 0.0) -> Array:
    """MSCN with numpy's padding mode `border`; values that are only rounding noise become `flat`."""
    padded = np.pad(image, 3, mode=border)  # type: ignore[call-overload]
    mean, square, total = np.zeros_like(image), np.zeros_like(image), 0.0
    for dy in range(7):
        for dx in range(7):
            weight = math.exp(-((dy - 3) ** 2 + (dx - 3) ** 2) / (2 * (7 / 6) ** 2))
            part = padded[dy : dy + image.shape[0], dx : dx + image.shape[1]]
            mean += weight * part
            square += weight * part**2
            total += weight
    mean, square = mean / total, square / total
    values = (image - mean) / (np.sqrt(np.abs(square - mean**2)) + 1)
    return np.where(np.abs(values) < 1e-6, flat, values)


def half(image: Array) -> Array:
    """Bicubic (a = -0.5), stretched by two, mirrored at the edges; pixel i lies between inputs 2i and 2i + 1."""

    def cubic(x: float) -> float:
        x = abs(x)
        if x <= 1:
            return 1.5 * x**3 - 2.5 * x**2 + 1
        return -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2 if x < 2 else 0.0

    def rows(x: Array) -> Array:
        n = len(x)
        out = np.zeros(((n + 1) // 2, x.shape[1]))
        for i in range(len(out)):
            for j in range(2 * i - 5, 2 * i + 7):
                mirrored = j % (2 * n)
                out[i] += 0.5 * cubic((j - 2 * i - 0.5) / 2) * x[mirrored if mirrored < n else 2 * n - 1 - mirrored]
        return out

    return rows(rows(image).T).T


def symmetric(values: Array) -> tuple[float, float]:
    """(shape, variance)."""
    variance = float(np.mean(values**2))
    ratios = gamma(1 / SHAPES) * gamma(3 / SHAPES) / gamma(2 / SHAPES) ** 2
    return float(SHAPES[np.argmin(np.abs(ratios - variance / np.mean(np.abs(values)) ** 2))]), variance


def asymmetric(values: Array) -> tuple[float, float, float]:
    """(shape, left, right deviation)."""
    left = math.sqrt(np.mean(values[values < 0] ** 2))
    right = math.sqrt(np.mean(values[values > 0] ** 2))
    g, r = left / right, np.mean(np.abs(values)) ** 2 / np.mean(values**2)
    ratios = gamma(2 / SHAPES) ** 2 / gamma(1 / SHAPES) / gamma(3 / SHAPES)
    wanted = r * (g**3 + 1) * (g + 1) / (g**2 + 1) ** 2
    return float(SHAPES[np.argmin((ratios - wanted) ** 2)]), left, right


def brisque_features(image: NDArray[np.uint8], flat: float = 0.0) -> Array:
    """36 features, two scales."""
    features: list[float] = []
    for level in (image.astype(float), half(image.astype(float))):
        values = mscn(level, "constant", flat)
        features += symmetric(values)
        for shift in SHIFTS:
            a, left, right = asymmetric(values * np.roll(values, shift, (0, 1)))
            mean = (right - left) * math.gamma(2 / a) / math.sqrt(math.gamma(1 / a) * math.gamma(3 / a))
            features += [a, mean, left**2, right**2]
    return np.array(features)


def niqe_features(image: NDArray[np.uint8]) -> Array:
    """36 features of each block, for an image of whole blocks of 96x96."""
    levels = [
        (mscn(level, "edge"), side) for level, side in ((image.astype(float), 96), (half(image.astype(float)), 48))
    ]
    blocks = []
    for y in range(image.shape[0] // 96):
        for x in range(image.shape[1] // 96):
            features: list[float] = []
            for values, side in levels:
                block = values[y * side : (y + 1) * side, x * side : (x + 1) * side]
                for shift in (None, *SHIFTS):
                    products = block if shift is None else block * np.roll(block, shift, (0, 1))
                    a, left, right = asymmetric(products)
                    left, right = (s * math.sqrt(math.gamma(1 / a) / math.gamma(3 / a)) for s in (left, right))
                    if shift is None:
                        features += [a, (left + right) / 2]
                    else:
                        features += [a, (right - left) * math.gamma(2 / a) / math.gamma(1 / a), left, right]
            blocks.append(features)
    return np.array(blocks)


def leaves(height: int = 192, width: int = 288, seed: int = 0) -> NDArray[np.uint8]:
    """Opaque discs of all sizes, one over the other: an image with statistics much like natural ones."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width), 128, np.uint8)
    for radius in 2 / (rng.random(3000) + 0.02):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        cv2.circle(image, centre, int(radius), int(rng.integers(20, 236)), -1, cv2.LINE_AA)
    return noisy(cv2.GaussianBlur(image, (0, 0), 0.7), 2, seed)


def poster(height: int = 96, width: int = 192) -> NDArray[np.uint8]:
    """Leaves with flat areas: black, white and gray ones, and clipped highlights."""
    image = leaves(height, width, 1)
    image[image > 180] = 255
    image[: height // 3, : width // 4] = 0
    image[-(height // 3) :, -(width // 4) :] = 77
    return image


def noisy(image: NDArray[np.uint8], sigma: float, seed: int = 1) -> NDArray[np.uint8]:
    noise = np.random.default_rng(seed).normal(0, sigma, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def luma(bmp: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """MATLAB's rgb2gray of OpenCV's B, G, R."""
    b, g, r = (bmp[..., i].astype(float) for i in range(3))
    gray = 0.298936021293775 * r + 0.587043074451121 * g + 0.114020904255103 * b
    return np.floor(gray + 0.5).astype(np.uint8)
