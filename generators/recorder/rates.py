"""Rates, backlog and losses of each camera during a capture."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.recorder.clips.layouts import Layout
from spike4dgs.generators.recorder.clips.ring import Block
from spike4dgs.generators.recorder.usb.reader import Reader

_EVERY_S = 0.2
_FRAMES = 4  # whose spikes are counted


@dataclass(frozen=True)
class Rate:
    """One camera's state, several times a second."""

    bytes_per_s: float
    ticks: int  # received since the trigger
    spikes_per_tick: float  # mean over the pixels of the newest frames, 0..1; NaN where they are not available
    backlog: int  # ring slots that wait
    lost_ticks: int  # for want of a free slot


class Rates:
    """Calls `on_rate` every 0.2 s, if there is one."""

    def __init__(
        self,
        layout: Layout,
        readers: Mapping[str, Reader],
        on_rate: Callable[[Mapping[str, Rate]], None] | None,
    ) -> None:
        self._layout, self._readers, self._on_rate = layout, readers, on_rate
        self._last_s = time.monotonic()
        self._last = {camera: reader.ring.position for camera, reader in readers.items()}

    def tell(self) -> None:
        """Call `on_rate` if the interval has passed."""
        now = time.monotonic()
        if self._on_rate is None or now - self._last_s < _EVERY_S:
            return
        rates = {}
        for camera, reader in self._readers.items():
            position, size = reader.ring.position, self._layout.frame_bytes
            rates[camera] = Rate(
                bytes_per_s=(position - self._last[camera]) / (now - self._last_s),
                ticks=(position - (reader.origin or 0)) // size,
                spikes_per_tick=spikes_per_tick(self._layout, reader.newest),
                backlog=reader.ring.waiting,
                lost_ticks=reader.ring.dropped // size,
            )
            self._last[camera] = position
        self._last_s = now
        self._on_rate(rates)


def spikes_per_tick(layout: Layout, block: Block | None) -> float:
    """Return the mean spikes per pixel and tick in a block's first whole frames; NaN where it has none."""
    if block is None or block.data is None:
        return math.nan
    size = layout.frame_bytes
    data = block.data[: (_FRAMES + 1) * size]
    start = layout.find(data) if layout.has_tags() else -block.position % size
    n = (len(data) - start) // size if start >= 0 else 0
    if n < 1:
        return math.nan
    pixels = np.empty((n, layout.payload_bytes), np.uint8)
    layout.unpack(data[start : start + n * size].reshape(n, size), pixels)
    return int(np.bitwise_count(pixels).sum()) / (n * layout.width * layout.height)
