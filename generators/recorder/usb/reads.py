"""Bulk reads in flight: their protocol, and libusb's asynchronous transfers, through the package `libusb1`."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import Any, Protocol

import usb1

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.generators.recorder.frames.gaps import OVERFLOW, SHORT_READ, STALL, TIME_OUT, UNPLUGGED

OK, SHORT, CANCELLED = "ok", SHORT_READ, "cancelled"
# After these a camera sends no usable data; each is the reason of the gap that follows.
FATAL = frozenset((STALL, OVERFLOW, UNPLUGGED))

_ENDINGS = {  # any other error on the wire halts the endpoint in the same way as a stall
    usb1.TRANSFER_ERROR: STALL,
    usb1.TRANSFER_TIMED_OUT: TIME_OUT,
    usb1.TRANSFER_CANCELLED: CANCELLED,
    usb1.TRANSFER_STALL: STALL,
    usb1.TRANSFER_NO_DEVICE: UNPLUGGED,
    usb1.TRANSFER_OVERFLOW: OVERFLOW,
}
_CANCEL_S = 5.0  # a host controller returns a cancelled read within milliseconds


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


class QueuedReads:
    """Up to `depth` bulk reads in flight; each waiting thread also serves libusb's events for the others.

    The reads themselves have no time limit, because cancelling one could lose its latest bytes; the caller of `wait`
    keeps the time.
    """

    def __init__(self, bus: usb1.USBContext, handle: usb1.USBDeviceHandle, endpoint: int, depth: int) -> None:
        self.depth = depth
        self._bus, self._endpoint = bus, endpoint
        self._idle = [handle.getTransfer() for _ in range(depth)]
        self._flying: deque[Any] = deque()  # in the order of submission
        self._ended: dict[Any, Completion] = {}

    @property
    def in_flight(self) -> int:
        """Number of reads that libusb has not returned."""
        return len(self._flying) - len(self._ended)

    def submit(self, buffer: UInt8) -> None:
        """Queue a read. Raises UserError where the system has no memory for it."""
        transfer = self._idle.pop()
        transfer.setBulk(self._endpoint, buffer, self._on_end)
        self._flying.append(transfer)
        try:
            transfer.submit()
        except usb1.USBErrorNoMem:
            self._idle.append(self._flying.pop())
            fix = "raise it: echo 256 | sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb"
            found = "its limit reached"
            raise problem("usbfs_memory_mb", f"memory for {self.depth} reads in flight", found, fix) from None
        except usb1.USBError as e:  # it was never in flight, and ends in its turn
            status = UNPLUGGED if isinstance(e, usb1.USBErrorNoDevice) else STALL
            self._ended[transfer] = Completion(0, time.monotonic_ns(), status)

    def wait(self, timeout_s: float) -> Completion | None:
        """Return the oldest read's end, or None."""
        deadline = time.monotonic() + timeout_s
        while self._flying:
            if (done := self._ended.pop(self._flying[0], None)) is not None:
                self._idle.append(self._flying.popleft())
                return done
            if (left := deadline - time.monotonic()) < 0:
                return None
            try:
                self._bus.handleEventsTimeout(left)
            except usb1.USBErrorInterrupted:
                pass
            except usb1.USBError:
                time.sleep(1e-3)  # a lasting error must not become a busy loop; the caller's time runs out
        return None

    def cancel(self) -> list[Completion]:
        """End every read and free the transfers. What libusb does not return, it keeps alive with its memory."""
        for transfer in reversed(self._flying):  # newest first, so that none continues after an older one has ended
            if transfer not in self._ended:
                try:
                    transfer.cancel()
                except (usb1.USBErrorNotFound, usb1.USBErrorNoDevice):
                    pass  # it has just ended, or ends by itself
        out = []
        deadline = time.monotonic() + _CANCEL_S
        while self._flying and (done := self.wait(deadline - time.monotonic())) is not None:
            out.append(done)
        for transfer in self._idle:
            transfer.close()
        self._idle.clear()
        return out

    def _on_end(self, transfer: Any) -> None:
        """Handle the end of a read; libusb calls this in whichever thread serves its events."""
        now, n = time.monotonic_ns(), transfer.getActualLength()
        status = _ENDINGS.get(transfer.getStatus(), OK if n == len(transfer.getBuffer()) else SHORT)
        self._ended[transfer] = Completion(n, now, status)
