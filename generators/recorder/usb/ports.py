"""Devices on the bus: what the recorder asks of one, and those that libusb finds.

PyUSB lists the devices. The package `libusb1` opens one and reads it, as PyUSB has no asynchronous transfers.
"""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from typing import Protocol

import usb.core
import usb1

from spike4dgs.benchmark.errors import problem
from spike4dgs.generators.recorder.usb.reads import QueuedReads, Transfers


class Port(Protocol):
    """A device on the bus, real or emulated. Its methods raise `usb1.USBError`."""

    vendor_id: int
    product_id: int
    speed: int  # enum libusb_speed
    where: str  # bus and address, for messages

    def serial(self) -> str:
        """Return the serial number. The device need not be open."""

    def open(self, interfaces: Collection[int]) -> None:
        """Open the device and claim interfaces."""

    def write(self, endpoint: int, data: bytes, timeout_ms: int) -> None:
        """Send one command."""

    def transfers(self, endpoint: int, transfer_bytes: int, depth: int) -> Transfers:
        """Return a queue of up to `depth` bulk reads of `transfer_bytes` in flight on an endpoint."""

    def close(self) -> None:
        """Release interfaces and device."""


class UsbPort:
    """A device that PyUSB has found; `context` opens it."""

    def __init__(self, context: usb1.USBContext, found: usb.core.Device) -> None:
        self._context = context
        self._handle: usb1.USBDeviceHandle | None = None
        self._address = (found.bus, found.address)
        self.vendor_id, self.product_id, self.speed = found.idVendor, found.idProduct, found.speed
        self.where = f"bus {found.bus} address {found.address}"

    def _device(self) -> usb1.USBDevice:
        """Return the device as libusb1 has it. Raises USBErrorNoDevice where it is gone."""
        for device in self._context.getDeviceIterator(skip_on_error=True):
            if (device.getBusNumber(), device.getDeviceAddress()) == self._address:
                return device
        raise usb1.USBErrorNoDevice

    def serial(self) -> str:
        """Return the serial number, "" where the device has none."""
        handle = self._device().open()
        try:
            return handle.getSerialNumber() or ""
        finally:
            handle.close()

    def open(self, interfaces: Collection[int]) -> None:
        """Open the device, give it a configuration if it has none, and claim interfaces from the kernel's drivers."""
        device = self._device()
        self._handle = device.open()
        if self._handle.getConfiguration() == 0:
            self._handle.setConfiguration(next(iter(device)).getConfigurationValue())
        with suppress(usb1.USBErrorNotSupported):  # some systems have no kernel drivers
            self._handle.setAutoDetachKernelDriver(True)
        for interface in interfaces:
            self._handle.claimInterface(interface)

    def write(self, endpoint: int, data: bytes, timeout_ms: int) -> None:
        """Send one command."""
        assert self._handle is not None
        self._handle.bulkWrite(endpoint, data, timeout_ms)

    def transfers(self, endpoint: int, transfer_bytes: int, depth: int) -> Transfers:
        """Return libusb's queue."""
        assert self._handle is not None
        return QueuedReads(self._context, self._handle, endpoint, depth)

    def close(self) -> None:
        """Close the device, which releases its interfaces."""
        if self._handle is not None:
            self._handle.close()


def usb_ports() -> list[UsbPort]:
    """Return the devices on this computer's buses. Raises UserError without libusb."""
    try:
        found = list(usb.core.find(find_all=True))
        context = usb1.USBContext().open()
    except (OSError, usb.core.NoBackendError):
        fix = "install it (Debian, Ubuntu: sudo apt install libusb-1.0-0)"
        raise problem("libusb", "the library libusb-1.0", "no such library", fix) from None
    return [UsbPort(context, device) for device in found]
