"""Reads from one camera: several queued in the USB stack where that is possible, else one at a time.

A camera sends without pause, so that a moment without a read in flight lets its small memory run over. `Transfers` is
the machinery that keeps reads in flight, `Link` the opened camera that makes it. The queue of libusb is in `queued.py`;
here are the one-at-a-time reads that every pyusb backend can do, and the choice between the two.
"""

from __future__ import annotations

import array
import errno
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import usb.core
import usb.util
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.generators.recorder import queued as libusb_queue
from spike4dgs.generators.recorder.profile import CameraProfile, RigProfile

UInt8 = NDArray[np.uint8]

OK, SHORT, CANCELLED = "ok", "short read", "cancelled"
# Statuses that end a camera; each is also the reason of the gap that follows.
TIME_OUT, STALL, OVERFLOW, UNPLUGGED = "time-out", "stall", "overflow", "unplugged"
FATAL = frozenset((TIME_OUT, STALL, OVERFLOW, UNPLUGGED))

_DRAIN_MS = 20  # a device that is silent for so long has sent what it still held
_DRAIN_BYTES = 64 << 20  # more than any device holds: it does not stop


@dataclass(frozen=True, slots=True)
class Completion:
    """A read that ended: the bytes it brought, when (CLOCK_MONOTONIC, ns), and how (`OK`, `SHORT`, ... above)."""

    bytes: int
    arrival_ns: int
    status: str


class Transfers(Protocol):
    """Reads in flight on one camera's data endpoint. They fill their buffers in the order of submission."""

    depth: int  # reads that may be in flight at once

    def submit(self, buffer: UInt8) -> None:
        """Queue a read that fills `buffer` [transfer_bytes]; the buffer belongs to the read until it has ended."""

    def wait(self, timeout_s: float) -> Completion | None:
        """The oldest read in flight, once it has ended; None if it has not within about `timeout_s`."""

    def cancel(self) -> list[Completion]:
        """End every read in flight, and return what each brought, oldest first. No buffer is written to after this."""


class Link(Protocol):
    """One opened camera."""

    serial: str
    queued: bool  # whether several reads can be in flight

    def start(self) -> None:
        """Send the camera's start sequence. Raises UserError where the camera does not take it."""

    def stop(self) -> None:
        """Send the stop sequence; a camera that is gone has stopped already."""

    def drain(self) -> int:
        """Read and drop what the camera still holds after `stop`; the number of bytes."""

    def transfers(self) -> Transfers:
        """New machinery for reads on this camera; one at a time is in use."""

    def close(self) -> None:
        """Release the device."""


@runtime_checkable
class QueueingBackend(Protocol):
    """A pyusb backend with a queue of its own, such as an emulator's; libusb's is in `queued.py`."""

    def open_transfers(self, device: usb.core.Device, endpoint: int, transfer_bytes: int, depth: int) -> Transfers:
        """Machinery that keeps up to `depth` bulk reads of `transfer_bytes` in flight on `endpoint`."""


def open_link(
    device: usb.core.Device, camera: CameraProfile, profile: RigProfile, queued: bool | None = None
) -> Link:
    """Open a camera that `find_cameras` has found, and claim its interfaces.

    `queued`: True insists on queued reads, False on one at a time, None takes the queue where there is one. Raises
    UserError where the device cannot be opened, or has no queue and one is insisted on.
    """
    raise NotImplementedError
