"""Devices on the bus: what the recorder asks of one, and libusb's devices, through the package `libusb1`."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from typing import Protocol

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
    """A device that libusb has found."""

    def __init__(self, bus: usb1.USBContext, device: usb1.USBDevice) -> None:
        self._bus, self._device = bus, device
        self._handle: usb1.USBDeviceHandle | None = None
        self.vendor_id, self.product_id = device.getVendorID(), device.getProductID()
        self.speed = device.getDeviceSpeed()
        self.where = f"bus {device.getBusNumber()} address {device.getDeviceAddress()}"

    def serial(self) -> str:
        """Return the serial number, "" where the device has none."""
        handle = self._device.open()
        try:
            return handle.getSerialNumber() or ""
        finally:
            handle.close()

    def open(self, interfaces: Collection[int]) -> None:
        """Open the device, give it a configuration if it has none, and claim interfaces from the kernel's drivers."""
        self._handle = self._device.open()
        if self._handle.getConfiguration() == 0:
            self._handle.setConfiguration(next(iter(self._device)).getConfigurationValue())
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
        return QueuedReads(self._bus, self._handle, endpoint, depth)

    def close(self) -> None:
        """Close the device, which releases its interfaces."""
        if self._handle is not None:
            self._handle.close()


def usb_ports() -> list[UsbPort]:
    """Return the devices on this computer's buses. Raises UserError without libusb."""
    try:
        bus = usb1.USBContext().open()
    except OSError:
        fix = "install it (Debian, Ubuntu: sudo apt install libusb-1.0-0)"
        raise problem("libusb1", "the library libusb-1.0", "no such library", fix) from None
    return [UsbPort(bus, device) for device in bus.getDeviceIterator(skip_on_error=True)]
