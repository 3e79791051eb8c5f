"""One opened camera: its start and stop sequences, and reads on it, several in flight where possible.

A camera sends without pause, so its small memory overflows at any moment without a read in flight. `open_link` uses
libusb's queue (`queued.py`) or a queue of the backend itself, else reads one at a time (`reads.py`).
"""

from __future__ import annotations

import contextlib
import errno
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import usb.core
import usb.util

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.generators.recorder.rig_profile import CameraProfile, RigProfile
from spike4dgs.generators.recorder.usb import queued as libusb
from spike4dgs.generators.recorder.usb.reads import SingleReads, Transfers

_DRAIN_MS = 20  # a device that is silent for so long has sent the rest of its data
_DRAIN_BYTES = 64 << 20  # more than a bridge or a camera holds: a device that sends so much was not stopped

_FIX_START = "check endpoint_out and start in the rig profile, then plug the camera in again"


@runtime_checkable
class QueueingBackend(Protocol):
    """A pyusb backend with a queue of its own, such as an emulator's."""

    def open_transfers(self, device: usb.core.Device, endpoint: int, transfer_bytes: int, depth: int) -> Transfers:
        """Return a queue of up to `depth` bulk reads of `transfer_bytes` in flight on `endpoint`."""


@dataclass(eq=False)
class Link:
    """One opened camera: a pyusb device whose interfaces are claimed."""

    device: usb.core.Device
    camera: CameraProfile
    profile: RigProfile
    queued: bool  # several reads can be in flight

    @property
    def restartable(self) -> bool:
        """True if the profile has its start and stop sequences. It then begins anew with a whole frame."""
        return bool(self.camera.start and self.camera.stop)

    def start(self) -> None:
        """Send the start sequence. Raises UserError where the camera refuses it."""
        try:
            self._write(self.camera.start)
        except usb.core.USBError as e:
            where, found = _name(self.camera), f"{e.strerror} while it was started"
            raise problem(where, "a camera that takes its start sequence", found, _FIX_START) from e

    def stop(self) -> None:
        """Send the stop sequence; a camera that is gone has already stopped."""
        with contextlib.suppress(usb.core.USBError):
            self._write(self.camera.stop)

    def drain(self) -> int:
        """Read and drop data until the camera is silent, but at most 64 MiB. Return the number of bytes."""
        size = self.profile.transfer_bytes
        reads = SingleReads(self.device, self.camera.endpoint_in, size, _DRAIN_MS)
        into, total = np.empty(size, np.uint8), 0
        while total < _DRAIN_BYTES:
            reads.submit(into)
            done = reads.wait(0)
            if done is None or not done.bytes:
                break
            total += done.bytes
        return total

    def transfers(self) -> Transfers:
        """Return new reads, queued or single ones, for one pass."""
        endpoint, size, depth = self.camera.endpoint_in, self.profile.transfer_bytes, self.profile.transfers
        if not self.queued:
            return SingleReads(self.device, endpoint, size, self.profile.timeout_ms)
        if isinstance(self.device.backend, QueueingBackend):
            return self.device.backend.open_transfers(self.device, endpoint, size, depth)
        return libusb.QueuedReads(self.device, endpoint, depth)

    def close(self) -> None:
        """Release interfaces and handle."""
        with contextlib.suppress(usb.core.USBError):
            usb.util.dispose_resources(self.device)

    def _write(self, commands: tuple[bytes, ...]) -> None:
        for command in commands:
            self.device.write(self.camera.endpoint_out, command, self.profile.timeout_ms)


def open_link(device: usb.core.Device, camera: CameraProfile, profile: RigProfile, queued: bool | None = None) -> Link:
    """Open a camera that `find_cameras` has found, and claim its interfaces.

    `queued`: True requires queued reads, False reads one at a time, None uses the queue where there is one. Raises
    UserError where the device cannot be opened, or lacks the required queue.
    """
    try:
        _claim(device, camera)
    except usb.core.USBError as e:
        raise _refused(camera, e) from e
    reason = None if isinstance(device.backend, QueueingBackend) else libusb.unavailable(device)
    if queued and reason:
        usb.util.dispose_resources(device)
        raise problem(_name(camera), "queued reads", reason, "install pyusb 1.3.1 with libusb-1.0, or do not insist")
    return Link(device, camera, profile, queued=not reason if queued is None else queued)


def _claim(device: usb.core.Device, camera: CameraProfile) -> None:
    try:
        device.get_active_configuration()
    except usb.core.USBError as e:
        if e.errno in (errno.EACCES, errno.ENODEV):
            raise
        device.set_configuration()
    for interface in {camera.interface, camera.control_interface} - {None}:
        # Some systems and backends have no kernel drivers; one that stays attached makes the claim fail.
        with contextlib.suppress(NotImplementedError, usb.core.USBError):
            if device.is_kernel_driver_active(interface):
                device.detach_kernel_driver(interface)
        usb.util.claim_interface(device, interface)


def _refused(camera: CameraProfile, error: usb.core.USBError) -> UserError:
    """Return the error for the system's refusal to open a camera."""
    expected = "a camera that can be opened"
    if error.errno == errno.EACCES:
        found, fix = "no permission", udev_fix(camera.vendor_id)
    elif error.errno == errno.EBUSY:
        found, fix = "another program holds it", "end that program"
    else:
        found, fix = str(error.strerror), "plug the camera in again"
    return problem(_name(camera), expected, found, fix)


def udev_fix(vendor_id: int) -> str:
    """Return the instruction that lets this user open a device."""
    rule = f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{vendor_id:04x}", MODE="0666"'
    return f"put the line {rule} into /etc/udev/rules.d/70-spike4dgs.rules and plug the camera in again"


def _name(camera: CameraProfile) -> str:
    return f"camera {camera.id} (serial {camera.serial})"
