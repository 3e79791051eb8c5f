"""The ticks that networks look at."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.spikes.stream import SpikeStream

WINDOW = 41  # ticks, of Spk2ImgNet
HALF_WINDOW = WINDOW // 2


def mirrored(indices: NDArray[np.integer[Any]], n: int) -> NDArray[np.int64]:
    """Indices into a sequence of length n that goes on beyond its ends as its own mirror image, ends repeated."""
    folded = np.asarray(indices, np.int64) % (2 * n)
    return np.minimum(folded, 2 * n - 1 - folded)


def window(stream: SpikeStream, tick: int, length: int = WINDOW) -> NDArray[np.uint8]:
    """Spikes of the `length` ticks, an odd number, around `tick` as [length, H, W] uint8 of 0 and 1.

    Beyond the clip's ends the clip is mirrored in time: the image is then still that of `tick`, as it would not be
    if the window moved, and pixels keep their rates, as they would not if the last tick were repeated.
    """
    half = length // 2
    ticks = mirrored(np.arange(tick - half, tick + half + 1), stream.n_ticks)
    first = int(ticks.min())
    return stream.window(first, int(ticks.max()) + 1)[ticks - first]
