"""Queued bulk reads on the libusb handle that pyusb has opened.

pyusb itself reads bulk endpoints one at a time. libusb's asynchronous calls are reached through the library and the
handle that its backend holds: `backend.lib`, `backend.ctx` and `device._ctx.managed_open().handle`. The last is a
private name, so `unavailable` checks first and reports what is missing; reads are then done one at a time. The transfer
structure is libusb's public ABI (libusb.h 1.0), declared here and not taken from pyusb.
"""

from __future__ import annotations

import ctypes as c
import time
from collections import deque
from typing import Any

import usb.core

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.generators.recorder.frames.gaps import OVERFLOW, STALL, TIME_OUT, UNPLUGGED
from spike4dgs.generators.recorder.usb.reads import CANCELLED, OK, SHORT, Completion


class _Transfer(c.Structure):
    """struct libusb_transfer, without the isochronous packets that follow it."""

    _fields_ = [
        ("dev_handle", c.c_void_p),
        ("flags", c.c_uint8),
        ("endpoint", c.c_uint8),
        ("type", c.c_uint8),
        ("timeout", c.c_uint),
        ("status", c.c_int),
        ("length", c.c_int),
        ("actual_length", c.c_int),
        ("callback", c.c_void_p),
        ("user_data", c.c_void_p),
        ("buffer", c.c_void_p),
        ("num_iso_packets", c.c_int),
    ]


class _Interval(c.Structure):
    """struct timeval."""

    _fields_ = [("seconds", c.c_long), ("microseconds", c.c_long)]


_Callback = c.CFUNCTYPE(None, c.c_void_p)
_TRANSFER_FN = c.CFUNCTYPE(c.c_int, c.c_void_p)
_FUNCTIONS = {  # prototypes of our own: pyusb's objects of the same functions keep theirs
    "libusb_alloc_transfer": c.CFUNCTYPE(c.c_void_p, c.c_int),
    "libusb_free_transfer": c.CFUNCTYPE(None, c.c_void_p),
    "libusb_submit_transfer": _TRANSFER_FN,
    "libusb_cancel_transfer": _TRANSFER_FN,
    "libusb_handle_events_timeout_completed": c.CFUNCTYPE(c.c_int, c.c_void_p, c.POINTER(_Interval), c.c_void_p),
}
_BULK = 2  # LIBUSB_TRANSFER_TYPE_BULK
_NO_DEVICE, _INTERRUPTED, _NO_MEM = -4, -10, -11  # enum libusb_error
_ENDINGS = {1: STALL, 2: TIME_OUT, 3: CANCELLED, 4: STALL, 5: UNPLUGGED, 6: OVERFLOW}  # enum libusb_transfer_status
_CANCEL_S = 5.0  # a host controller returns a cancelled read within milliseconds

# Reads that libusb did not return, with their memory: libusb may still write to it, so it is never freed.
_LOST: list[Any] = []


def unavailable(device: usb.core.Device) -> str | None:
    """Return why no reads can be queued on this device, or None if they can be."""
    backend: Any = getattr(device, "backend", None)
    missing = [name for name in ("lib", "ctx") if not hasattr(backend, name)]
    if missing:
        return f"the pyusb backend {type(backend).__name__} has no {' and no '.join(missing)}"
    absent = [name for name in _FUNCTIONS if not hasattr(backend.lib, name)]
    if absent:
        return f"this libusb has no {absent[0]}"
    opened = getattr(getattr(device, "_ctx", None), "managed_open", None)
    if not callable(opened) or not hasattr(opened(), "handle"):
        return "this version of pyusb keeps its libusb handle elsewhere"
    return None


class QueuedReads:
    """Up to `depth` bulk reads in flight; each waiting thread also serves libusb's events for the others.

    For devices for which `unavailable` returns None. The reads themselves have no time limit, because cancelling one
    could lose its latest bytes; the caller of `wait` keeps the time.
    """

    def __init__(self, device: usb.core.Device, endpoint: int, depth: int) -> None:
        self.depth = depth
        self._context = device.backend.ctx
        self._handle = device._ctx.managed_open().handle.value
        self._endpoint = endpoint
        lib = device.backend.lib
        self._call = {name: prototype((name, lib)) for name, prototype in _FUNCTIONS.items()}
        self._callback = _Callback(self._on_end)  # libusb keeps the address, so we keep the object
        self._completed = c.c_int(0)
        self._idle = [self._call["libusb_alloc_transfer"](0) for _ in range(depth)]
        self._flying: deque[tuple[int, UInt8]] = deque()  # address, buffer; in the order of submission
        self._ended: dict[int, Completion] = {}

    @property
    def in_flight(self) -> int:
        """Number of reads that libusb has not returned."""
        return len(self._flying) - len(self._ended)

    def submit(self, buffer: UInt8) -> None:
        """Queue a read. Raises UserError where the system has no memory for it."""
        address = self._idle.pop()
        t = _Transfer.from_address(address)
        t.dev_handle, t.endpoint, t.type, t.timeout = self._handle, self._endpoint, _BULK, 0
        t.length, t.buffer, t.callback = buffer.nbytes, buffer.ctypes.data, c.cast(self._callback, c.c_void_p)
        self._flying.append((address, buffer))
        code = self._call["libusb_submit_transfer"](address)
        if code == _NO_MEM:
            self._flying.pop()
            self._idle.append(address)
            fix = "raise it: echo 256 | sudo tee /sys/module/usbcore/parameters/usbfs_memory_mb"
            raise problem("usbfs_memory_mb", f"memory for {self.depth} reads in flight", "its limit reached", fix)
        if code < 0:  # it was never in flight, and ends in its turn
            status = UNPLUGGED if code == _NO_DEVICE else STALL
            self._ended[address] = Completion(0, time.monotonic_ns(), status)

    def wait(self, timeout_s: float) -> Completion | None:
        """Return the oldest read's end, or None."""
        deadline = time.monotonic() + timeout_s
        while self._flying:
            self._completed.value = 0  # before checking: an end after this makes the call below return at once
            if (done := self._ended.pop(self._flying[0][0], None)) is not None:
                self._idle.append(self._flying.popleft()[0])
                return done
            if (left := deadline - time.monotonic()) < 0:
                return None
            self._serve(left)
        return None

    def cancel(self) -> list[Completion]:
        """End every read and free the transfers."""
        for address, _ in reversed(self._flying):  # newest first, so that none continues after an older one has ended
            if address not in self._ended:
                self._call["libusb_cancel_transfer"](address)
        out = []
        deadline = time.monotonic() + _CANCEL_S
        while self._flying and (done := self.wait(deadline - time.monotonic())) is not None:
            out.append(done)
        if self._flying:
            _LOST.append((self, list(self._flying)))
        for address in self._idle:
            self._call["libusb_free_transfer"](address)
        self._idle.clear()
        return out

    def _serve(self, timeout_s: float) -> None:
        interval = _Interval(int(timeout_s), int(timeout_s % 1 * 1e6))
        flag = c.addressof(self._completed)
        code = self._call["libusb_handle_events_timeout_completed"](self._context, c.byref(interval), flag)
        if code < 0 and code != _INTERRUPTED:
            time.sleep(1e-3)  # a lasting error must not become a busy loop; the caller's time runs out

    def _on_end(self, address: int) -> None:
        """Handle the end of a read; libusb calls this in whichever thread serves its events."""
        now = time.monotonic_ns()
        t = _Transfer.from_address(address)
        status = _ENDINGS.get(t.status, OK if t.actual_length == t.length else SHORT)
        self._ended[address] = Completion(t.actual_length, now, status)
        self._completed.value = 1
