"""A pyusb backend whose devices are an emulated array: `record --emulate` and the tests run the recorder's own code.

    profile = scene_profile(scene)
    backend = EmulatedBackend(EmulatedArray(profile, scene_streams(scene)))
    devices = usb.core.find(find_all=True, backend=backend)

Reads can be queued (`open_transfers`), as libusb's asynchronous calls do; pyusb's own `read` does one at a time. What
a blocking read brought before it failed is lost, as it is with libusb.
"""

from __future__ import annotations

import array
import errno
import math
import os
import struct
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import usb.backend
import usb.core
import usb.util

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.generators.recorder.emulation.array import EmulatedArray
from spike4dgs.generators.recorder.emulation.camera import DUPLICATE, HIGH_SPEED, MISSING, EmulatedCamera
from spike4dgs.generators.recorder.frames.gaps import OVERFLOW, STALL, UNPLUGGED
from spike4dgs.generators.recorder.rig_profile import CameraProfile
from spike4dgs.generators.recorder.usb.reads import CANCELLED, Completion

_ERRNO = {STALL: errno.EPIPE, OVERFLOW: errno.EOVERFLOW, UNPLUGGED: errno.ENODEV}
_SPEED_HIGH, _SPEED_SUPER = 3, 4  # enum libusb_speed
_STRINGS = ("", "Spike4DGS", "emulated spike camera")  # string descriptors; the serial number follows
_LANGUAGE = b"\x04\x03\x09\x04"  # string descriptor 0: US English


@dataclass(frozen=True, eq=False)
class _Plug:
    """A device on the emulated bus; it is its own handle."""

    address: int
    camera: EmulatedCamera
    speed: int


class _Descriptor(SimpleNamespace):
    """A USB descriptor; what is not given is 0."""

    extra_descriptors = ()

    def __getattr__(self, name: str) -> int:
        return 0


class EmulatedBackend(usb.backend.IBackend):  # type: ignore[misc]
    """The devices of an emulated array, one for each camera of its profile."""

    def __init__(self, emulated: EmulatedArray) -> None:
        self.emulated = emulated
        self._plugs: list[_Plug] = []
        for name, camera in emulated.cameras.items():
            speed = _SPEED_HIGH if emulated.has(name, HIGH_SPEED) else _SPEED_SUPER
            copies = 0 if emulated.has(name, MISSING) else 2 if emulated.has(name, DUPLICATE) else 1
            self._plugs += [_Plug(len(self._plugs) + i + 1, camera, speed) for i in range(copies)]

    def enumerate_devices(self) -> Iterator[_Plug]:
        """Yield the devices that are plugged in."""
        return (plug for plug in self._plugs if plug.camera.dead != UNPLUGGED)

    def get_parent(self, dev: _Plug) -> None:
        """Return None: emulated devices are on no hub."""

    def get_device_descriptor(self, dev: _Plug) -> _Descriptor:
        """Return the descriptor of a vendor-specific USB 3.1 device, with its position on the bus."""
        return _Descriptor(
            bcdUSB=0x0310 if dev.speed == _SPEED_SUPER else 0x0210,
            bMaxPacketSize0=9,
            idVendor=dev.camera.profile.vendor_id,
            idProduct=dev.camera.profile.product_id,
            bcdDevice=0x0100,
            iManufacturer=1,
            iProduct=2,
            iSerialNumber=len(_STRINGS),
            bNumConfigurations=1,
            address=dev.address,
            bus=1,
            port_number=dev.address,
            port_numbers=(dev.address,),
            speed=dev.speed,
        )

    def get_configuration_descriptor(self, dev: _Plug, config: int) -> _Descriptor:
        """Return the only configuration."""
        if config:
            raise IndexError(config)
        count = len(interfaces(dev.camera.profile))
        return _Descriptor(bNumInterfaces=count, bConfigurationValue=1, bmAttributes=0x80, bMaxPower=50)

    def get_interface_descriptor(self, dev: _Plug, intf: int, alt: int, config: int) -> _Descriptor:
        """Return the interfaces that the rig profile names."""
        number, endpoints = list(interfaces(dev.camera.profile).items())[intf]
        if alt:
            raise IndexError(alt)
        return _Descriptor(bInterfaceNumber=number, bNumEndpoints=len(endpoints), bInterfaceClass=0xFF)

    def get_endpoint_descriptor(self, dev: _Plug, ep: int, intf: int, alt: int, config: int) -> _Descriptor:
        """Return bulk endpoints."""
        return _Descriptor(
            bEndpointAddress=list(interfaces(dev.camera.profile).values())[intf][ep],
            bmAttributes=usb.util.ENDPOINT_TYPE_BULK,
            wMaxPacketSize=1024 if dev.speed == _SPEED_SUPER else 512,
        )

    def open_device(self, dev: _Plug) -> _Plug:
        """Return the handle of a device that is plugged in."""
        _check_plugged(dev)
        return dev

    def close_device(self, dev_handle: _Plug) -> None:
        """Do nothing: there is no resource to release."""

    def get_configuration(self, dev_handle: _Plug) -> int:
        """Return 1, the only configuration."""
        _check_plugged(dev_handle)
        return 1

    def set_configuration(self, dev_handle: _Plug, config_value: int) -> None:
        """Accept the only configuration."""
        _check_plugged(dev_handle)

    def claim_interface(self, dev_handle: _Plug, intf: int) -> None:
        """Accept the claim: no other program can hold the interface."""
        _check_plugged(dev_handle)

    def release_interface(self, dev_handle: _Plug, intf: int) -> None:
        """Do nothing: there is no resource to release."""

    def clear_halt(self, dev_handle: _Plug, ep: int) -> None:
        """End a stall."""
        _check_plugged(dev_handle)
        dev_handle.camera.clear_halt()

    def ctrl_transfer(
        self,
        dev_handle: _Plug,
        bmRequestType: int,  # noqa: N803 - names of the interface
        bRequest: int,  # noqa: N803
        wValue: int,  # noqa: N803
        wIndex: int,  # noqa: N803
        data: array.array[int],
        timeout: int,
    ) -> int:
        """Answer requests for string descriptors; stall on any other request."""
        _check_plugged(dev_handle)
        if (bmRequestType, bRequest, wValue >> 8) != (0x80, 6, usb.util.DESC_TYPE_STRING):
            raise _error(errno.EPIPE)
        answer = string_descriptor(dev_handle.camera.profile, wValue & 255)[: len(data)]
        data[: len(answer)] = array.array("B", answer)
        return len(answer)

    def bulk_write(self, dev_handle: _Plug, ep: int, intf: int, data: array.array[int], timeout: int) -> int:
        """Pass a command to the camera; stall on an unknown one."""
        _check_plugged(dev_handle)
        if not self.emulated.write(dev_handle.camera.profile.id, data.tobytes()):
            raise _error(errno.EPIPE)
        return len(data) * data.itemsize

    def bulk_read(self, dev_handle: _Plug, ep: int, intf: int, buff: array.array[int], timeout: int) -> int:
        """Do one blocking read. A time-out that cuts it off returns the bytes so far, as libusb does."""
        camera, into = dev_handle.camera, np.frombuffer(buff, np.uint8)
        with camera.changed:
            camera.lose_unread(0)
            done = _wait(camera, into, timeout * 1e-3 if timeout else math.inf) or camera.read(into, cut=True)
        if done is None or done == (0, CANCELLED):
            raise usb.core.USBTimeoutError(os.strerror(errno.ETIMEDOUT), None, errno.ETIMEDOUT)
        if done[1] in _ERRNO:
            raise _error(_ERRNO[done[1]])
        return done[0]

    def open_transfers(self, device: usb.core.Device, endpoint: int, transfer_bytes: int, depth: int) -> EmulatedReads:
        """Return a queue of reads on a device's data endpoint."""
        plug = next(p for p in self._plugs if p.address == device.address)
        return EmulatedReads(plug.camera, transfer_bytes, depth)


class EmulatedReads:
    """Reads in flight on an emulated camera, a `Transfers`; `wait` copies the bytes that have arrived."""

    def __init__(self, camera: EmulatedCamera, transfer_bytes: int, depth: int) -> None:
        self.depth = depth
        self._camera, self._size = camera, transfer_bytes
        self._flying: deque[UInt8] = deque()

    @property
    def in_flight(self) -> int:
        """Number of reads that have not ended; for a camera without a clock, those that `wait` has not returned."""
        with self._camera.changed:
            return len(self._flying) - self._camera.ended(len(self._flying), self._size)

    def submit(self, buffer: UInt8) -> None:
        """Queue a read."""
        with self._camera.changed:
            self._camera.lose_unread(len(self._flying) * self._size)
            self._flying.append(buffer)

    def wait(self, timeout_s: float) -> Completion | None:
        """Return the oldest read's end, or None."""
        if not self._flying:
            return None
        with self._camera.changed:
            done = _wait(self._camera, self._flying[0], timeout_s)
        if done is None:
            return None
        self._flying.popleft()
        return Completion(done[0], time.monotonic_ns(), done[1])

    def cancel(self) -> list[Completion]:
        """End every read with the bytes that have arrived."""
        out = []
        with self._camera.changed:
            while self._flying:
                n, status = self._camera.read(self._flying.popleft(), cut=True) or (0, CANCELLED)
                out.append(Completion(n, time.monotonic_ns(), status))
        return out


def _wait(camera: EmulatedCamera, into: UInt8, timeout_s: float) -> tuple[int, str] | None:
    """Wait for a read's end, with `camera.changed` held."""
    deadline = time.monotonic() + timeout_s
    while (done := camera.read(into)) is None:
        now = time.monotonic()
        if now >= deadline:
            return None
        left = min(deadline, camera.due_s(len(into))) - now
        camera.changed.wait(None if math.isinf(left) else max(left, 0.0))
    return done


def interfaces(camera: CameraProfile) -> dict[int, list[int]]:
    """Return interface number -> endpoint addresses, as the profile names them."""
    out: dict[int, list[int]] = {camera.interface: [camera.endpoint_in]}
    if camera.endpoint_out is not None:
        control = camera.interface if camera.control_interface is None else camera.control_interface
        out.setdefault(control, []).append(camera.endpoint_out)
    return dict(sorted(out.items()))


def string_descriptor(camera: CameraProfile, index: int) -> bytes:
    """Return a camera's answer to a request for a string: manufacturer, product, serial number."""
    if index == 0:
        return _LANGUAGE
    text = (*_STRINGS, camera.serial)[index].encode("utf-16-le")
    return struct.pack("<BB", 2 + len(text), usb.util.DESC_TYPE_STRING) + text


def _check_plugged(plug: _Plug) -> None:
    if plug.camera.dead == UNPLUGGED:
        raise _error(errno.ENODEV)


def _error(number: int) -> usb.core.USBError:
    return usb.core.USBError(os.strerror(number), None, number)
