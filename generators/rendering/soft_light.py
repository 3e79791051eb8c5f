"""Light that moving objects add or remove far around them: bounced light, wide penumbrae, dim reflections.

It varies slowly over the image and in time, so tracing it for each key is not worth the time. At anchor times, on every
second pixel of every second row, cheap renderings with and without the instances from the same random numbers give the
relative change of radiance. Smoothed over space and blended in time, it multiplies the background, whose texture and
low noise remain. Below 0.5 % it is exactly zero: those pixels are the background, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from scipy import ndimage

STEP = 2  # pixels between the anchors' samples
SPP = 32
MOTION_PX = 4.0  # of the fastest point between two anchors
_SIGMA = 1.25  # of the smoothing, in anchor samples
_FAR_SIGMA = 6.0  # of the smoothing that fills in samples behind the objects
_DEAD, _FULL = 0.005, 0.012  # relative change: zero below the first, in full above the second

Trace = Callable[[np.ndarray, int, bool, float], np.ndarray]
Region = Callable[[float], np.ndarray]


class SoftLight:
    """The relative change of radiance outside the traced region, at any time.

    Args:
        shape: (views, height, width).
        trace: (flat pixels [K], spp, with the instances?, t_s) -> radiance [K].
        region: t_s -> [C, H, W] bool, the pixels that every key traces.
        anchor_s: time between anchors.

    Attributes:
        spp: samples per pixel of the cheap renderings, a power of two; SPP unless it is set before the first.
    """

    def __init__(self, shape: tuple[int, int, int], trace: Trace, region: Region, anchor_s: float) -> None:
        self._shape, self._trace, self._region, self._anchor_s = shape, trace, region, anchor_s
        self.spp = SPP
        self._anchors: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def change(self, t_s: float) -> np.ndarray:
        """Return [C, H, W] float32: radiance at `t_s` over the background's, minus one; 0 for a negligible change."""
        first = int(np.floor(t_s / self._anchor_s))
        late = np.float32(t_s / self._anchor_s - first)
        # sums and weights are blended separately: samples hidden at one anchor are filled in from the other
        (sum0, weight0), (sum1, weight1) = self._anchor(first), self._anchor(first + 1)
        coarse = (sum0 * (1 - late) + sum1 * late) / (weight0 * (1 - late) + weight1 * late)
        size = np.abs(coarse)
        ramp = np.clip((size - _DEAD) / (_FULL - _DEAD), 0, 1)
        return self._enlarge(coarse * ramp * ramp * (3 - 2 * ramp))

    def _enlarge(self, coarse: np.ndarray) -> np.ndarray:
        """Interpolate bilinearly from the anchors' samples [C, h, w] to pixels [C, H, W]."""
        for axis, size in ((1, self._shape[1]), (2, self._shape[2])):
            at = np.minimum(np.arange(size) / STEP, coarse.shape[axis] - 1)
            low = at.astype(int)
            high = np.minimum(low + 1, coarse.shape[axis] - 1)
            part = np.expand_dims((at - low).astype(np.float32), (0, 3 - axis))
            coarse = np.take(coarse, low, axis) * (1 - part) + np.take(coarse, high, axis) * part
        return coarse

    @cached_property
    def _without(self) -> tuple[np.ndarray, np.ndarray]:
        """Return flat numbers [C, h, w] of the anchors' pixels and their radiance without the instances."""
        flat = np.arange(int(np.prod(self._shape))).reshape(self._shape)[:, ::STEP, ::STEP]
        return flat, self._trace(flat.ravel(), self.spp, False, 0.0).reshape(flat.shape)

    def _anchor(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the weighted sum of the relative change around each sample, and the weight: [C, h, w] each."""
        if number not in self._anchors:
            if len(self._anchors) > 3:  # times usually ascend; a dropped anchor can be made again, with equal values
                del self._anchors[min(self._anchors)]
            self._anchors[number] = self._make_anchor(number * self._anchor_s)
        return self._anchors[number]

    def _make_anchor(self, t_s: float) -> tuple[np.ndarray, np.ndarray]:
        flat, without = self._without
        seen = ~self._region(t_s)[:, ::STEP, ::STEP]
        relative, weight = np.zeros(flat.shape, np.float32), np.where(seen, without, 0).astype(np.float32)
        # brighter samples have more weight: sums of radiance are smoothed, not ratios, so dark noise does not spread
        relative[seen] = self._trace(flat[seen], self.spp, True, t_s) - without[seen]
        near, far = (0, _SIGMA, _SIGMA), (0, _FAR_SIGMA, _FAR_SIGMA)
        total = ndimage.gaussian_filter(relative, near) + 1e-3 * ndimage.gaussian_filter(relative, far)
        return total, ndimage.gaussian_filter(weight, near) + 1e-3 * ndimage.gaussian_filter(weight, far) + 1e-12
