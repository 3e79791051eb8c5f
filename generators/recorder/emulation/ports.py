"""The devices of an emulated array: `record --emulate` and the tests run the recorder's own code.

profile = scene_profile(scene)
ports = emulated_ports(EmulatedArray(profile, scene_streams(scene)))
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Collection

import usb1

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.generators.recorder.emulation.array import EmulatedArray
from spike4dgs.generators.recorder.emulation.camera import DUPLICATE, HIGH_SPEED, MISSING, EmulatedCamera
from spike4dgs.generators.recorder.frames.gaps import UNPLUGGED
from spike4dgs.generators.recorder.usb.reads import CANCELLED, Completion


class EmulatedPort:
    """The device of an emulated camera, a `Port`."""

    def __init__(self, array: EmulatedArray, camera: EmulatedCamera, address: int) -> None:
        self._array, self._camera = array, camera
        self.vendor_id, self.product_id = camera.profile.vendor_id, camera.profile.product_id
        self.speed = usb1.SPEED_HIGH if array.has(camera.profile.id, HIGH_SPEED) else usb1.SPEED_SUPER
        self.where = f"bus 1 address {address}"

    def serial(self) -> str:
        """Return the profile's serial number."""
        return self._camera.profile.serial

    def open(self, interfaces: Collection[int]) -> None:
        """Accept the claim: no other program can hold the interfaces."""
        self._check_plugged()

    def write(self, endpoint: int, data: bytes, timeout_ms: int) -> None:
        """Pass a command to the camera; stall on an unknown one."""
        self._check_plugged()
        if not self._array.write(self._camera.profile.id, data):
            raise usb1.USBErrorPipe

    def transfers(self, endpoint: int, transfer_bytes: int, depth: int) -> EmulatedReads:
        """Return a queue of reads."""
        return EmulatedReads(self._camera, transfer_bytes, depth)

    def close(self) -> None:
        """Do nothing: there is no resource to release."""

    def _check_plugged(self) -> None:
        if self._camera.dead == UNPLUGGED:
            raise usb1.USBErrorNoDevice


def emulated_ports(array: EmulatedArray) -> list[EmulatedPort]:
    """Return the devices of an array, one for each camera of its profile unless a fault says otherwise."""
    ports: list[EmulatedPort] = []
    for name, camera in array.cameras.items():
        copies = 0 if array.has(name, MISSING) else 2 if array.has(name, DUPLICATE) else 1
        for _ in range(copies):
            ports.append(EmulatedPort(array, camera, len(ports) + 1))
    return ports


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
