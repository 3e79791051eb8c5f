"""Statistics of a stream that distinguish cameras and simulators.

- Adjacent intervals: a pixel that keeps the charge above the threshold and sees steady light has intervals of two
  neighbouring lengths between its spikes; one that drops the charge has one, one with much temporal noise has many.
  The share of pixels with other intervals grows with the noise of one spike, so it determines the number of photons
  per spike; it depends on the rates too, so compare recordings of equal rates and length.
- Excess count variance: over windows of a recording, a pixel's count varies by f (1 - f) around its mean even without
  noise, f being the fraction of the mean; the unbiased variance of the counts minus that is temporal noise, plus
  f (1 - f) / (windows - 1) from the estimate itself, which a noise-free pixel shows too.
- Local gain spread: each pixel over the median of the 5x5 around it; the spread of that from its median absolute
  deviation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

WINDOWS = (10, 20, 40, 60)  # ticks


@dataclass(frozen=True)
class StreamStatistics:
    """Statistics of the chosen pixels.

    Attributes:
        one_interval, two_intervals: share of pixels with intervals of one length; of exactly two neighbouring lengths.
        excess_variance: excess count variance for each of the WINDOWS.
    """

    one_interval: float
    two_intervals: float
    excess_variance: tuple[float, ...]

    @property
    def other_intervals(self) -> float:
        """Share of pixels with three lengths of intervals or more, or two that are not neighbours."""
        return 1 - self.one_interval - self.two_intervals


def stream_statistics(spikes: NDArray[np.bool_], pixels: NDArray[np.bool_] | None = None) -> StreamStatistics:
    """Return statistics of an unpacked recording [T, H, W], of those of `pixels` [H, W] with three spikes or more."""
    chosen = spikes.reshape(len(spikes), -1) if pixels is None else spikes[:, pixels]
    chosen = chosen[:, chosen.sum(0) >= 3]
    shortest, longest = _interval_range(chosen)
    one, two = float((shortest == longest).mean()), float((longest == shortest + 1).mean())
    return StreamStatistics(one, two, tuple(excess_variance(chosen, window) for window in WINDOWS))


def excess_variance(spikes: NDArray[np.bool_], window: int) -> float:
    """Return the mean over the pixels of [T, P]: unbiased variance of the counts in windows, minus f (1 - f)."""
    n = len(spikes) // window
    counts = spikes[: n * window].reshape(n, window, -1).sum(1)
    fraction = counts.mean(0) % 1
    return float((counts.var(0, ddof=1) - fraction * (1 - fraction)).mean())


def local_spread(image: NDArray[np.floating]) -> float:
    """Return the robust relative spread of pixels [H, W] against their neighbours."""
    relative = image / median_filter(image, 5) - 1
    return float(1.4826 * np.median(np.abs(relative - np.median(relative))))


def _interval_range(spikes: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the shortest and longest interval of each pixel of [T, P]."""
    pixel, tick = np.nonzero(spikes.T)
    same = pixel[1:] == pixel[:-1]
    length, owner = np.diff(tick)[same], pixel[1:][same]
    shortest, longest = np.full(spikes.shape[1], len(spikes)), np.zeros(spikes.shape[1], np.int64)
    np.minimum.at(shortest, owner, length)
    np.maximum.at(longest, owner, length)
    return shortest, longest
