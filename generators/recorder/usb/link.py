"""One opened camera: its start and stop sequences, and reads on it, several in flight.

A camera sends without pause, so its small memory overflows at any moment without a read in flight.
"""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

import numpy as np
import usb1

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.generators.recorder.rig_profile import CameraProfile, RigProfile
from spike4dgs.generators.recorder.usb.ports import Port
from spike4dgs.generators.recorder.usb.reads import Transfers

_DRAIN_S = 0.02  # a device that is silent for so long has sent the rest of its data
# A device that sends more, or for longer, than a bridge or a camera holds data was not stopped.
_DRAIN_BYTES, _MOST_DRAIN_S = 64 << 20, 0.5

_FIX_START = "check endpoint_out and start in the rig profile, then plug the camera in again"


@dataclass(eq=False)
class Link:
    """One opened camera: a device whose interfaces are claimed."""

    port: Port
    camera: CameraProfile
    profile: RigProfile

    @property
    def restartable(self) -> bool:
        """True if the profile has its start and stop sequences. It then begins anew with a whole frame."""
        return bool(self.camera.start and self.camera.stop)

    def start(self) -> None:
        """Send the start sequence. Raises UserError where the camera refuses it."""
        try:
            self._write(self.camera.start)
        except usb1.USBError as e:
            where, found = _name(self.camera), f"{e} while it was started"
            raise problem(where, "a camera that takes its start sequence", found, _FIX_START) from e

    def stop(self) -> None:
        """Send the stop sequence; a camera that is gone has already stopped."""
        with contextlib.suppress(usb1.USBError):
            self._write(self.camera.stop)

    def drain(self) -> bool:
        """Read and drop data until the camera is silent. Return False for one that goes on, for 64 MiB or 0.5 s."""
        size = self.profile.transfer_bytes
        into, total, end = np.empty(size, np.uint8), 0, time.monotonic() + _MOST_DRAIN_S
        while total < _DRAIN_BYTES and time.monotonic() < end:
            reads = self.port.transfers(self.camera.endpoint_in, size, 1)
            reads.submit(into)
            done = reads.wait(_DRAIN_S)  # a slow camera takes longer to fill a read, whose bytes the cancelled one has
            ended = [*([] if done is None else [done]), *reads.cancel()]
            if not (n := sum(each.bytes for each in ended)):
                return True
            total += n
        return False

    def transfers(self) -> Transfers:
        """Return new reads for one pass."""
        return self.port.transfers(self.camera.endpoint_in, self.profile.transfer_bytes, self.profile.transfers)

    def close(self) -> None:
        """Release interfaces and device."""
        with contextlib.suppress(usb1.USBError):
            self.port.close()

    def _write(self, commands: tuple[bytes, ...]) -> None:
        for command in commands:
            assert self.camera.endpoint_out is not None, "a profile with commands has it"
            self.port.write(self.camera.endpoint_out, command, self.profile.timeout_ms)


def open_link(port: Port, camera: CameraProfile, profile: RigProfile) -> Link:
    """Open a camera that `find_cameras` has found, and claim its interfaces. Raises UserError where that fails."""
    control = camera.interface if camera.control_interface is None else camera.control_interface
    try:
        port.open(sorted({camera.interface, control}))
    except usb1.USBError as e:
        port.close()
        raise _refused(camera, e) from e
    return Link(port, camera, profile)


def _refused(camera: CameraProfile, error: usb1.USBError) -> UserError:
    """Return the error for the system's refusal to open a camera."""
    found, fix = str(error), "plug the camera in again"
    if isinstance(error, usb1.USBErrorAccess):
        found, fix = "no permission", udev_fix(camera.vendor_id)
    elif isinstance(error, usb1.USBErrorBusy):
        found, fix = "another program holds it", "end that program"
    return problem(_name(camera), "a camera that can be opened", found, fix)


def udev_fix(vendor_id: int) -> str:
    """Return the instruction that lets this user open a device."""
    rule = f'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{vendor_id:04x}", MODE="0666"'
    return f"put the line {rule} into /etc/udev/rules.d/70-spike4dgs.rules and plug the camera in again"


def _name(camera: CameraProfile) -> str:
    return f"camera {camera.id} (serial {camera.serial})"
