"""An emulated array as devices of the kernel's usbfs, by libumockdev: libusb runs on it unchanged.

    with UsbMock(EmulatedArray(profile, streams, paced=False)):
        usb_ports()

libumockdev's preloaded library sends every ioctl on a device node here. Works only in a process that was started with
`LD_PRELOAD=libumockdev-preload.so.0`, and on 64-bit machines; written against umockdev 0.17.
"""

from __future__ import annotations

import ctypes as c
import errno
import struct
import traceback
from collections import deque
from typing import Any

import numpy as np
from usb_testbed import (
    CAPABILITIES,
    CONTROL,
    DISCARD,
    GET_DRIVER,
    GRANTED,
    REAP,
    REAP_NOW,
    SUBMIT,
    Handler,
    Urb,
    library,
)

from spike4dgs.generators.recorder.emulation.array import EmulatedArray
from spike4dgs.generators.recorder.emulation.camera import DUPLICATE, HIGH_SPEED, MISSING, EmulatedCamera
from spike4dgs.generators.recorder.frames.gaps import OVERFLOW, STALL, UNPLUGGED
from spike4dgs.generators.recorder.rig_profile import CameraProfile

# Zero packets, bulk continuation, no packet size limit, scatter-gather, reaping after a disconnect.
_CAPABILITIES = 0x01 | 0x02 | 0x04 | 0x08 | 0x10
_STATUS = {STALL: -errno.EPIPE, OVERFLOW: -errno.EOVERFLOW, UNPLUGGED: -errno.ESHUTDOWN}
_ROOT_HUB = "/devices/pci0000:00/0000:00:14.0/usb1"


class UsbMock:
    """The devices of an array on a mocked bus, while the context lasts."""

    def __init__(self, array: EmulatedArray) -> None:
        self.array = array
        self.devices: list[MockDevice] = []

    def __enter__(self) -> UsbMock:
        self.lib = library()
        self.testbed = self.lib.testbed_new()
        hub = struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x0300, 9, 0, 3, 9, 0x1D6B, 3, 0x0617, 0, 0, 0, 1)
        hub += struct.pack("<BBHBBBBB", 9, 2, 31, 1, 1, 0, 0xE0, 0)
        hub += struct.pack("<BBBBBBBBB", 9, 4, 0, 0, 1, 9, 0, 0, 0)
        hub += struct.pack("<BBBBHB", 7, 5, 0x81, 3, 4, 12) + struct.pack("<BBBBH", 6, 0x30, 0, 0, 2)
        self.add(_ROOT_HUB, 1, hub, {"idVendor": "1d6b", "idProduct": "0003", "devpath": "0", "speed": "5000"})
        for name, camera in self.array.cameras.items():
            copies = 0 if self.array.has(name, MISSING) else 2 if self.array.has(name, DUPLICATE) else 1
            for _ in range(copies):
                self.devices.append(MockDevice(self, camera, number=len(self.devices) + 2))
        return self

    def add(self, path: str, number: int, descriptors: bytes, attributes: dict[str, str]) -> None:
        """Add a device to sysfs, with its node."""
        node, text = f"bus/usb/001/{number:03d}", descriptors.hex().upper()
        properties = {"DEVNAME": f"/dev/{node}", "DEVTYPE": "usb_device", "SUBSYSTEM": "usb", "BUSNUM": "001"}
        properties |= {"DEVNUM": f"{number:03d}", "MAJOR": "189", "MINOR": str(number - 1)}
        attributes = attributes | {"busnum": "1", "devnum": str(number), "dev": f"189:{number - 1}"}
        attributes |= {"bConfigurationValue": "1", "bNumConfigurations": "1"}
        lines = [f"P: {path}", f"N: {node}={text}", *(f"E: {k}={v}" for k, v in properties.items())]
        lines += [*(f"A: {k}={v}" for k, v in attributes.items()), f"H: descriptors={text}", "", ""]
        self.check(self.lib.testbed_add_from_string, "\n".join(lines).encode())

    def check(self, function: Any, *arguments: Any) -> None:
        """Call a function of the testbed. Raises OSError where it fails."""
        error = c.c_void_p()
        if not function(self.testbed, *arguments, c.byref(error)):
            raise OSError(f"libumockdev refused {arguments}")

    def __exit__(self, *exc: object) -> None:
        for device in self.devices:
            self.check(self.lib.testbed_detach_ioctl, device.node.encode())
        self.lib.unref(self.testbed)


class MockDevice:
    """One camera as the kernel shows it: descriptors, string requests, commands out, queued reads in."""

    def __init__(self, mock: UsbMock, camera: EmulatedCamera, number: int) -> None:
        self.mock, self.camera = mock, camera
        self.node, self.path = f"/dev/bus/usb/001/{number:03d}", f"{_ROOT_HUB}/1-{number}"
        self.most_queued = 0  # reads on the data endpoint at once
        self.unhandled: list[str] = []
        self._reads: deque[tuple[Any, Urb]] = deque()  # on the data endpoint, in the order of submission
        self._done: deque[tuple[Any, Urb]] = deque()
        self._gone = False
        profile, slow = camera.profile, mock.array.has(camera.profile.id, HIGH_SPEED)
        attributes = {"idVendor": f"{profile.vendor_id:04x}", "idProduct": f"{profile.product_id:04x}"}
        attributes |= {"devpath": str(number), "serial": profile.serial, "speed": "480" if slow else "5000"}
        mock.add(self.path, number, descriptors(camera, slow), attributes)
        self._callback = Handler(self._on_ioctl)  # libumockdev keeps the address, so we keep the object
        self._handler = mock.lib.ioctl_base_new()
        mock.lib.connect(self._handler, b"handle-ioctl", self._callback, None, None, 0)
        mock.check(mock.lib.testbed_attach_ioctl, self.node.encode(), self._handler)

    def _on_ioctl(self, _handler: int, client: int, _user: int) -> int:
        try:
            answer = self._answer(client)
        except Exception:  # noqa: BLE001 - nothing above this frame is Python
            traceback.print_exc()
            answer = -errno.EIO
        self.mock.lib.ioctl_client_complete(client, -1 if answer < 0 else 0, max(-answer, 0))
        return 1

    def _answer(self, client: int) -> int:
        """Return 0, or the negative errno of an ioctl."""
        lib = self.mock.lib
        request, argument = lib.ioctl_client_get_request(client), lib.ioctl_client_get_arg(client)
        if self._gone and request not in (REAP, REAP_NOW):
            return -errno.ENODEV
        if request == SUBMIT:
            return self._submit(argument)
        if request == DISCARD:
            return self._discard(c.c_ulong.from_address(argument.contents.data).value)
        if request in (REAP, REAP_NOW):
            return self._reap(argument)
        if request == CAPABILITIES:
            c.c_uint32.from_address(self._resolve(argument, 0, 4).contents.data).value = _CAPABILITIES
            return 0
        if request in GRANTED:
            return 0
        if request == GET_DRIVER:
            return -errno.ENODATA  # no kernel driver holds it
        self.unhandled.append(hex(request))
        return -errno.ENOTTY

    def _submit(self, argument: Any) -> int:
        memory = self._resolve(argument, 0, c.sizeof(Urb))
        urb = Urb.from_address(memory.contents.data)
        if urb.buffer_length:
            self._resolve(memory, Urb.buffer.offset, urb.buffer_length)  # now urb.buffer is a copy here
        if urb.type != CONTROL and urb.endpoint & 0x80:
            self._reads.append((memory, urb))
            self.most_queued = max(self.most_queued, len(self._reads))
            return 0
        data = c.string_at(urb.buffer, urb.buffer_length)
        if urb.type == CONTROL:
            self._control(urb, data)
        else:
            known = self.mock.array.write(self.camera.profile.id, data)
            urb.status, urb.actual_length = (0, len(data)) if known else (-errno.EPIPE, 0)
        self._done.append((memory, urb))
        return 0

    def _control(self, urb: Urb, data: bytes) -> None:
        kind, request, value, _, length = struct.unpack("<BBHHH", data[:8])
        if (kind, request, value >> 8) != (0x80, 6, 3):  # anything but a string descriptor
            urb.status, urb.actual_length = -errno.EPIPE, 0
            return
        text = string_descriptor(self.camera.profile, value & 255)[:length]
        c.memmove(urb.buffer + 8, text, len(text))
        urb.status, urb.actual_length = 0, len(text)

    def _discard(self, address: int) -> int:
        for i, (memory, urb) in enumerate(self._reads):
            if memory.contents.client_addr == address:
                del self._reads[i]
                n, _ = (self._read(urb, cut=True) or (0, "")) if i == 0 else (0, "")
                urb.status, urb.actual_length = -errno.ENOENT, n
                self._done.append((memory, urb))
                return 0
        return -errno.EINVAL  # it has ended already

    def _reap(self, argument: Any) -> int:
        if self._reads and not self._done:
            memory, urb = self._reads[0]
            if (ended := self._read(urb)) is not None:
                self._reads.popleft()
                urb.actual_length, urb.status = ended[0], _STATUS.get(ended[1], 0)
                self._done.append((memory, urb))
                if ended[1] == UNPLUGGED:
                    self._unplug()
        if not self._done:
            return -errno.ENODEV if self._gone else -errno.EAGAIN
        memory, _ = self._done.popleft()
        pointer = self._resolve(argument, 0, 8)
        error = c.c_void_p()
        self.mock.lib.ioctl_data_set_ptr(pointer, 0, memory, c.byref(error))
        return 0

    def _read(self, urb: Urb, cut: bool = False) -> tuple[int, str] | None:
        memory = (c.c_uint8 * urb.buffer_length).from_address(urb.buffer)
        with self.camera.changed:
            return self.camera.read(np.frombuffer(memory, np.uint8), cut)

    def _unplug(self) -> None:
        """End every urb, then remove the device from the bus, as the kernel does."""
        self._gone = True
        for memory, urb in self._reads:
            urb.status, urb.actual_length = _STATUS[UNPLUGGED], 0
            self._done.append((memory, urb))
        self._reads.clear()
        self.mock.lib.testbed_uevent(self.mock.testbed, f"/sys{self.path}".encode(), b"remove")

    def _resolve(self, memory: Any, offset: int, length: int) -> Any:
        error = c.c_void_p()
        found = self.mock.lib.ioctl_data_resolve(memory, offset, length, c.byref(error))
        if not found:
            raise OSError("the client's memory cannot be read")
        return found


def interfaces(camera: CameraProfile) -> dict[int, list[int]]:
    """Return interface number -> endpoint addresses, as the profile names them."""
    out: dict[int, list[int]] = {camera.interface: [camera.endpoint_in]}
    if camera.endpoint_out is not None:
        control = camera.interface if camera.control_interface is None else camera.control_interface
        out.setdefault(control, []).append(camera.endpoint_out)
    return dict(sorted(out.items()))


def string_descriptor(camera: CameraProfile, index: int) -> bytes:
    """Return the answer to a request for a string: languages (US English), manufacturer, product, serial number."""
    if index == 0:
        return b"\x04\x03\x09\x04"
    text = ("", "Spike4DGS", "emulated spike camera", camera.serial)[index].encode("utf-16-le")
    return struct.pack("<BB", 2 + len(text), 3) + text


def descriptors(camera: EmulatedCamera, slow: bool) -> bytes:
    """Return device and configuration descriptors of a camera, at SuperSpeed or, if `slow`, at High Speed."""
    profile, ports = camera.profile, interfaces(camera.profile)
    body = b""
    for number, endpoints in ports.items():
        body += struct.pack("<BBBBBBBBB", 9, 4, number, 0, len(endpoints), 0xFF, 0, 0, 0)
        for address in endpoints:
            body += struct.pack("<BBBBHB", 7, 5, address, 2, 512 if slow else 1024, 0)
            body += b"" if slow else struct.pack("<BBBBH", 6, 0x30, 15, 0, 0)  # SuperSpeed endpoint companion
    version, packet = (0x0210, 64) if slow else (0x0310, 9)
    ids = profile.vendor_id, profile.product_id
    device = struct.pack("<BBHBBBBHHHBBBB", 18, 1, version, 0, 0, 0, packet, *ids, 0x0100, 1, 2, 3, 1)
    return device + struct.pack("<BBHBBBBB", 9, 2, 9 + len(body), len(ports), 1, 0, 0x80, 50) + body
