"""Bulk reads in flight: what every kind of them offers, and the kind that any pyusb backend can do, one at a time."""

from __future__ import annotations

import array
import errno
import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import usb.core
from numpy.typing import NDArray

from spike4dgs.generators.recorder.frames.gaps import OVERFLOW, SHORT_READ, STALL, TIME_OUT, UNPLUGGED

UInt8 = NDArray[np.uint8]

OK, SHORT, CANCELLED = "ok", SHORT_READ, "cancelled"
# After these a camera sends no more that could be used; each is the reason of the gap that follows.
FATAL = frozenset((STALL, OVERFLOW, UNPLUGGED))

# Whatever else goes wrong on the wire (EIO, EPROTO, ...) halts the endpoint in the same way as a stall.
_STATUS = {errno.ENODEV: UNPLUGGED, errno.ENOENT: UNPLUGGED, errno.EOVERFLOW: OVERFLOW, errno.ETIMEDOUT: TIME_OUT}


@dataclass(frozen=True, slots=True)
class Completion:
    """A read that ended: the bytes it brought, when (CLOCK_MONOTONIC, ns), and how.

    `status` is OK, SHORT, CANCELLED, TIME_OUT (whose bytes are good) or one of FATAL.
    """

    bytes: int
    arrival_ns: int
    status: str


class Transfers(Protocol):
    """Reads in flight on one camera's data endpoint. They fill their buffers in the order of submission.

    Made for one pass: after `cancel` it takes no more reads.
    """

    depth: int  # reads that may be in flight at once

    @property
    def in_flight(self) -> int:
        """Reads that have not ended yet, whether or not `wait` has told."""

    def submit(self, buffer: UInt8) -> None:
        """Queue a read that fills `buffer` [transfer_bytes]; the buffer belongs to the read until it has ended."""

    def wait(self, timeout_s: float) -> Completion | None:
        """The oldest read that `wait` has not told about, once it has ended; None if that takes over `timeout_s`."""

    def cancel(self) -> list[Completion]:
        """End every read, and return what each brought, oldest first. No buffer is written to after this."""


class SingleReads:
    """One read at a time, by pyusb's blocking call: between two of them the camera's own memory has to hold.

    A read happens within `wait`, which takes up to `timeout_ms` whatever it is asked; it ends with TIME_OUT then.
    """

    depth = 1

    def __init__(self, device: usb.core.Device, endpoint: int, transfer_bytes: int, timeout_ms: int) -> None:
        self._device, self._endpoint, self._timeout_ms = device, endpoint, timeout_ms
        self._array = array.array("B", bytes(transfer_bytes))  # pyusb fills an array.array in place, and nothing else
        self._filled = np.frombuffer(self._array, np.uint8)
        self._buffer: UInt8 | None = None

    @property
    def in_flight(self) -> int:
        """1 between submission and the end of `wait`."""
        return int(self._buffer is not None)

    def submit(self, buffer: UInt8) -> None:
        """Note where the next read's bytes go."""
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
        """Forget the submitted buffer: nothing is being read."""
        self._buffer = None
        return []

    def _ending(self, n: int, begun_ns: int) -> str:
        if n == len(self._filled):
            return OK
        # libusb returns what came before a time-out as a read that is short.
        late = time.monotonic_ns() - begun_ns >= 1_000_000 * self._timeout_ms
        return TIME_OUT if late else SHORT
