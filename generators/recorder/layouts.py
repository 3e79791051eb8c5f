"""Frame layouts: how a camera's frames lie on the wire, and how they become packed ticks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

UInt8 = NDArray[np.uint8]
Int64 = NDArray[np.int64]


@dataclass(frozen=True)
class Layout:
    """Frames of `frame_bytes` on the wire, of which `payload_bytes` are the packed pixels."""

    name: str
    width: int
    height: int
    frame_bytes: int
    payload_bytes: int

    def count_tags(self) -> bool:
        """Whether every frame carries a counter."""
        raise NotImplementedError

    def unpack(self, raw: UInt8, out: UInt8) -> Int64 | None:
        """Raw frames [n, frame_bytes] -> their pixels in out [n, payload_bytes]; returns counters [n], or None."""
        raise NotImplementedError

    def pack(self, payload: UInt8, first_count: int) -> UInt8:
        """Packed ticks [n, payload_bytes] -> raw frames [n, frame_bytes], counted from `first_count`."""
        raise NotImplementedError


def make_layout(name: str, width: int, height: int) -> Layout:
    """A layout ("plain", "tagged-rows", "line-tagged") for a picture size it can have, else UserError."""
    raise NotImplementedError
