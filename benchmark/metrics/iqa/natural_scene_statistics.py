"""The statistics that BRISQUE and NIQE share: locally normalised brightness, and distributions fitted to it.

A natural image, after each pixel loses its neighbourhood's mean and is divided by its neighbourhood's contrast
("mean subtracted, contrast normalised": MSCN), has nearly Gaussian values, and the products of neighbours follow an
asymmetric distribution. Blur, noise and compression bend these laws; the shapes and widths of the fits measure that.

    mu = w * I      sigma = sqrt(|w * I^2 - mu^2|)      MSCN = (I - mu) / (sigma + 1)

Both metrics use the image and the image at half its size. Constants are those of the authors' MATLAB releases, so that
the scores are theirs. One detail differs: MSCN values that are only rounding noise become exactly zero (`NOISE`).

Sources: Mittal, Moorthy, Bovik, "No-Reference Image Quality Assessment in the Spatial Domain", IEEE TIP 2012;
Lasmar, Stitou, Berthoumieu, "Multiscale skewed heavy tailed model for texture analysis", ICIP 2009 (asymmetric fit).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.spikes.bits import kernel

_FILE = "live_parameters.npz"


def load_parameters(metric: str) -> dict[str, Float64]:
    """Return the arrays of one metric ("brisque" or "niqe") by name, in float64."""
    with files("spike4dgs.benchmark.metrics.iqa").joinpath(_FILE).open("rb") as f, np.load(f) as arrays:
        return {
            name.removeprefix(f"{metric}_"): arrays[name].astype(np.float64)
            for name in arrays.files
            if name.startswith(f"{metric}_")
        }


WINDOW = 7  # pixels; the side of the Gaussian window w ...
WINDOW_SIGMA = WINDOW / 6  # ... which ends at three standard deviations

# In a flat region I - mu is zero but for the last bits, and those depend on the order in which a filter adds. The fits
# count values by their sign, so that noise would move BRISQUE by points (10 for an image with 30 % flat pixels). The
# rounding is about 1e-13. A difference of one gray level at a corner of the window is 1.6e-4, so that real texture
# below 1e-6 takes a coincidence.
NOISE = 1e-6

# MATLAB's imresize(I, 0.5): the cubic kernel with a = -0.5, stretched by two, at distances 1/4, 3/4, 5/4, 7/4 of its
# unit. All weights are whole 256ths: halving 8-bit images is exact in float64, and in any order.
_HALVING = np.array([-3, -9, 29, 111, 111, 29, -9, -3]) / 256

ABS, LEFT, RIGHT, N_LEFT, N_RIGHT = range(5)  # what is summed: |v|, v^2 of v < 0, v^2 of v > 0, and how many of each
VALUE = 0  # row of `neighbour_sums` for the values themselves; rows 1 to 4 are the products with four neighbours


def check_image(image: NDArray[Any], least: tuple[int, int], where: str) -> None:
    """Raise UserError unless `image` is gray 8-bit [H, W], at least `least` (height, width), and not constant."""
    if image.ndim != 2 or image.dtype != np.uint8:
        found = f"{image.dtype} of shape {image.shape}"
        raise problem(where, "a gray 8-bit image (H, W)", found, "encode it as sRGB first (encode_srgb)")
    if image.shape[0] < least[0] or image.shape[1] < least[1]:
        raise problem(where, f"at least {least[0]}x{least[1]} pixels", f"{image.shape}", "use a larger image")
    if image.min() == image.max():
        raise degenerate(where, f"{image.flat[0]} everywhere")


def degenerate(where: str, found: str, expected: str = "an image with texture") -> UserError:
    """Build the error for an image with too little texture to have statistics, for the caller to raise."""
    return problem(where, expected, found, "leave the metric out for it: it has no score")


def normalise(image: Float64, border: int) -> Float64:
    """Return the MSCN [H, W] of gray levels [H, W] (0 to 255); `border` is OpenCV's rule beyond the edges."""
    import cv2

    taps = _window()
    mean, square = (
        np.asarray(cv2.sepFilter2D(values, cv2.CV_64F, taps, taps, borderType=border), np.float64)
        for values in (image, image * image)
    )
    deviation = np.sqrt(np.abs(square - mean * mean))
    mscn: Float64 = (image - mean) / (deviation + 1)  # one gray level: keeps flat regions finite
    mscn[np.abs(mscn) < NOISE] = 0
    return mscn


def halve(image: Float64) -> Float64:
    """Return the image at half size [ceil(H / 2), ceil(W / 2)], low-pass filtered as MATLAB's imresize does by default.

    Output pixel i is the weighted sum of input pixels 2i - 3 to 2i + 4; beyond the edge the image is mirrored.
    """
    for _ in range(2):  # rows; then, transposed, columns
        n = (len(image) + 1) // 2
        padded = np.pad(image, ((3, 4), (0, 0)), mode="symmetric")
        image = sum(weight * padded[k : k + 2 * n : 2] for k, weight in enumerate(_HALVING)).T
    return np.ascontiguousarray(image)


def neighbour_sums(blocks: Float64) -> Float64:
    """Return moments [n, 5, 5] of blocks [n, H, W] and neighbour products: a row per kind, columns ABS to N_RIGHT.

    Row 0 is the values, rows 1 to 4 the products with the neighbour to the right, below, below right and below left.
    A block goes on at its other side, as the authors' circular shifts have it.
    """
    sums = np.zeros((len(blocks), 5, 5))
    wrapped = np.concatenate([blocks[..., -1:], blocks, blocks[..., :1]], axis=-1)
    _neighbour_sums(wrapped, np.ones(blocks.shape[-1]), sums)
    return sums


@kernel
def _neighbour_sums(wrapped: Float64, ones: Float64, sums: Float64) -> None:
    n, height, width = wrapped.shape
    for i in range(n):
        for y in range(height):
            row, below = wrapped[i, y], wrapped[i, y + 1 if y + 1 < height else 0]
            here = row[1 : width - 1]
            _add(here, ones, sums[i, 0])
            _add(here, row[2:], sums[i, 1])
            _add(here, below[1 : width - 1], sums[i, 2])
            _add(here, below[2:], sums[i, 3])
            _add(here, below[: width - 2], sums[i, 4])


@kernel
def _add(a: Float64, b: Float64, sums: Float64) -> None:
    """Add the moments of the products a * b of a row [W] to sums [5]."""
    total = left = right = 0.0
    n_left = n_right = 0
    for x in range(len(a)):
        v = a[np.uint64(x)] * b[np.uint64(x)]
        total += abs(v)
        left += v * v if v < 0 else 0.0
        right += v * v if v > 0 else 0.0
        n_left += v < 0
        n_right += v > 0
    sums[0] += total
    sums[1] += left
    sums[2] += right
    sums[3] += n_left
    sums[4] += n_right


@dataclass(frozen=True, eq=False)
class Asymmetric:
    """Asymmetric generalised Gaussians: the density falls as exp(-(|v| / scale)^shape), with one scale for each side.

    Where a side has no values, its deviation is NaN.
    """

    shape: Float64  # [...] 2 is a Gaussian, 1 a Laplacian
    left: Float64  # [...] root mean square of the negative values
    right: Float64  # [...] and of the positive ones

    @property
    def scales(self) -> tuple[Float64, Float64]:
        """The scales of the left and of the right side."""
        from scipy.special import gamma

        ratio = np.sqrt(gamma(1 / self.shape) / gamma(3 / self.shape))
        return self.left * ratio, self.right * ratio

    @property
    def mean(self) -> Float64:
        """The mean of the distribution: eta = (right scale - left scale) Gamma(2 / shape) / Gamma(1 / shape)."""
        from scipy.special import gamma

        left, right = self.scales
        return np.asarray((right - left) * gamma(2 / self.shape) / gamma(1 / self.shape))


def fit_symmetric(sums: Float64, count: int) -> tuple[Float64, Float64]:
    """Return shape and variance [...] of generalised Gaussians of mean 0, from moments [..., 5] of `count` values each.

    Moment matching: E[v^2] / E[|v|]^2 = Gamma(1/a) Gamma(3/a) / Gamma(2/a)^2, solved for the shape a.
    """
    variance = (sums[..., LEFT] + sums[..., RIGHT]) / count
    shapes, ratios = _shapes()
    inverse = 1 / ratios[::-1]  # ascending
    return shapes[::-1][_nearest(inverse, variance / (sums[..., ABS] / count) ** 2)], variance


def fit_asymmetric(sums: Float64, count: int) -> Asymmetric:
    """Return asymmetric fits [...] from moments [..., 5] of `count` values each (Lasmar et al. 2009).

    With g = left / right deviation and R = E[|v|]^2 / E[v^2], the shape a solves
    Gamma(2/a)^2 / (Gamma(1/a) Gamma(3/a)) = R (g^3 + 1) (g + 1) / (g^2 + 1)^2.
    """
    left, right = (
        np.sqrt(np.divide(sums[..., s], sums[..., n], out=np.full(sums.shape[:-1], np.nan), where=sums[..., n] > 0))
        for s, n in ((LEFT, N_LEFT), (RIGHT, N_RIGHT))
    )
    g = left / right
    squares = sums[..., LEFT] + sums[..., RIGHT]
    ratio = sums[..., ABS] ** 2 / np.where(squares > 0, squares, np.nan) / count
    shapes, ratios = _shapes()
    shape = shapes[_nearest(ratios, ratio * (g**3 + 1) * (g + 1) / (g**2 + 1) ** 2)]
    return Asymmetric(shape, left, right)


@cache
def _window() -> Float64:
    """Return the normalised taps [7] of the Gaussian window, which is their outer product."""
    offset = np.arange(WINDOW) - WINDOW // 2
    taps = np.exp(-(offset**2) / (2 * WINDOW_SIGMA**2))
    return np.asarray(taps / taps.sum())


@cache
def _shapes() -> tuple[Float64, Float64]:
    """Return the shapes a of a fit [9801], and Gamma(2/a)^2 / (Gamma(1/a) Gamma(3/a)) of each, which ascends.

    The authors search this grid; a root finder would be finer, and differ from their scores in the fourth digit.
    """
    from scipy.special import gamma

    shapes = np.arange(200, 10001) / 1000
    return shapes, gamma(2 / shapes) ** 2 / (gamma(1 / shapes) * gamma(3 / shapes))


def _nearest(table: Float64, values: Float64) -> NDArray[np.intp]:
    """Return the index of the entry of an ascending `table` nearest to each value; the last one for NaN."""
    return np.searchsorted((table[1:] + table[:-1]) / 2, values)
