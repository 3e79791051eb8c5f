"""Windows of ticks: the input of the networks."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.spikes.stream import SpikeStream

WINDOW = 41  # ticks, of Spk2ImgNet
HALF_WINDOW = WINDOW // 2


def mirrored(indices: NDArray[np.integer[Any]], n: int) -> NDArray[np.int64]:
    """Return indices into a sequence of length n that is mirrored beyond its ends, the ends repeated."""
    folded = np.asarray(indices, np.int64) % (2 * n)
    return np.minimum(folded, 2 * n - 1 - folded)


def window(stream: SpikeStream, tick: int, length: int = WINDOW) -> NDArray[np.uint8]:
    """Return the spikes of `length` ticks, an odd number, around `tick` as [length, H, W] uint8 of 0 and 1.

    Beyond its ends the clip is mirrored in time. A window that moved instead would give the image of another tick, and
    a repeated last tick would change the pixels' rates.
    """
    half = length // 2
    ticks = mirrored(np.arange(tick - half, tick + half + 1), stream.n_ticks)
    first = int(ticks.min())
    return stream.window(first, int(ticks.max()) + 1)[ticks - first]
