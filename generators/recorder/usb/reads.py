"""Bulk reads in flight: their common protocol, and single reads, which work with any pyusb backend."""

from __future__ import annotations

import array
import errno
import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import usb.core

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.generators.recorder.frames.gaps import OVERFLOW, SHORT_READ, STALL, TIME_OUT, UNPLUGGED

OK, SHORT, CANCELLED = "ok", SHORT_READ, "cancelled"
# After these a camera sends no usable data; each is the reason of the gap that follows.
FATAL = frozenset((STALL, OVERFLOW, UNPLUGGED))

# All other errors on the wire (EIO, EPROTO, ...) halt the endpoint in the same way as a stall.
_STATUS = {errno.ENODEV: UNPLUGGED, errno.ENOENT: UNPLUGGED, errno.EOVERFLOW: OVERFLOW, errno.ETIMEDOUT: TIME_OUT}


@dataclass(frozen=True, slots=True)
class Completion:
    """A read that ended: its bytes, its time (CLOCK_MONOTONIC, ns), and its status.

    `status` is OK, SHORT, CANCELLED, TIME_OUT (whose bytes are good) or one of FATAL.
    """

    bytes: int
    arrival_ns: int
    status: str


class Transfers(Protocol):
    """Reads in flight on one camera's data endpoint. They fill their buffers in the order of submission.

    For one pass: after `cancel` it accepts no more reads.
    """

    depth: int  # reads that may be in flight at once

    @property
    def in_flight(self) -> int:
        """Number of reads that have not ended yet, whether or not `wait` has returned them."""

    def submit(self, buffer: UInt8) -> None:
        """Queue a read that fills `buffer` [transfer_bytes]; the buffer belongs to the read until it has ended."""

    def wait(self, timeout_s: float) -> Completion | None:
        """Return the oldest read not yet returned, once it has ended; None if that takes over `timeout_s`."""

    def cancel(self) -> list[Completion]:
        """End every read, and return them, oldest first. No buffer is written to after this."""


class SingleReads:
    """One read at a time, by pyusb's blocking call: between two reads the camera's own memory must suffice.

    A read happens within `wait`, which takes up to `timeout_ms` regardless of its argument; it then ends with TIME_OUT.
    """

    depth = 1

    def __init__(self, device: usb.core.Device, endpoint: int, transfer_bytes: int, timeout_ms: int) -> None:
        self._device, self._endpoint, self._timeout_ms = device, endpoint, timeout_ms
        self._array = array.array("B", bytes(transfer_bytes))  # pyusb fills only an array.array in place
        self._filled = np.frombuffer(self._array, np.uint8)
        self._buffer: UInt8 | None = None

    @property
    def in_flight(self) -> int:
        """1 between submission and the end of `wait`."""
        return int(self._buffer is not None)

    def submit(self, buffer: UInt8) -> None:
        """Store the buffer of the next read."""
        self._buffer = buffer

    def wait(self, timeout_s: float) -> Completion | None:
        """Read, and copy to the submitted buffer."""
        if self._buffer is None:
            return None
        begun = time.monotonic_ns()
        try:
            n = self._device.read(self._endpoint, self._array, self._timeout_ms)
        except usb.core.USBError as e:
            late = isinstance(e, usb.core.USBTimeoutError)
            done = Completion(0, time.monotonic_ns(), TIME_OUT if late else _STATUS.get(e.errno or 0, STALL))
        else:
            done = Completion(n, time.monotonic_ns(), self._ending(n, begun))
            self._buffer[:n] = self._filled[:n]
        self._buffer = None
        return done

    def cancel(self) -> list[Completion]:
        """Forget the submitted buffer: no read is in progress."""
        self._buffer = None
        return []

    def _ending(self, n: int, begun_ns: int) -> str:
        if n == len(self._filled):
            return OK
        # libusb returns the data before a time-out as a short read.
        late = time.monotonic_ns() - begun_ns >= 1_000_000 * self._timeout_ms
        return TIME_OUT if late else SHORT
