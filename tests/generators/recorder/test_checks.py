"""Checks before a capture, and opening a device: every refusal states a fix."""

from __future__ import annotations

import array
import errno
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import usb.core
import usb.util
from fake_camera import rig

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.recorder import checks
from spike4dgs.generators.recorder.frames.gaps import OVERFLOW, STALL, TIME_OUT, UNPLUGGED
from spike4dgs.generators.recorder.usb import queued, transport
from spike4dgs.generators.recorder.usb.reads import OK, SHORT, Completion, SingleReads

ARRAY = rig(9, transfer_bytes=262144, transfers=16)


def device(serial: Any, speed: int | None = 4, address: int = 1) -> Any:
    """Return a device for `find_cameras`; a serial that is an exception is raised."""

    class Device(SimpleNamespace):
        @property
        def serial_number(self) -> str:
            if isinstance(serial, Exception):
                raise serial
            return str(serial)

    return Device(speed=speed, bus=2, address=address, idVendor=0x0403)


def plug(monkeypatch: pytest.MonkeyPatch, devices: list[Any]) -> None:
    def find(find_all: bool, idVendor: int, idProduct: int, backend: Any) -> list[Any]:  # noqa: N803 - pyusb's names
        assert find_all and (idVendor, idProduct, backend) == (0x0403, 0x601F, None)
        return devices

    monkeypatch.setattr(usb.core, "find", find)


def test_cameras_are_found_by_their_serial_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    devices = [device("S2"), device("another"), device("S0", speed=5), device("S1")]
    plug(monkeypatch, devices)
    assert checks.find_cameras(rig(3)) == {"cam_00": devices[2], "cam_01": devices[3], "cam_02": devices[0]}


@pytest.mark.parametrize(
    ("devices", "message"),
    [
        (["S0"], r"camera cam_01 \(serial S1\), cam_02 \(serial S2\): .* found only the serials S0; check cable"),
        ([], "found only the serials none; check"),
        (["S0", "S1", "S2", "S1"], r"cam_01 \(serial S1\): .* several, at bus 2 address 1, bus 2 address 3; give each"),
        (
            ["S0", ("S1", 3), ("S2", None)],
            "cam_01 .*, cam_02 .* SuperSpeed .* High Speed.*, an unknown speed; use",
        ),
        (
            [usb.core.USBError("Access denied", None, errno.EACCES)],
            'found .*Access denied; put the line SUBSYSTEM=="usb"',
        ),
        ([ValueError("The device has no langid")], "a serial number, found The device has no langid; put the line"),
    ],
)
def test_an_array_that_is_not_complete_is_refused(
    monkeypatch: pytest.MonkeyPatch, devices: list[Any], message: str
) -> None:
    made = [d if isinstance(d, tuple) else (d, 4) for d in devices]
    plug(monkeypatch, [device(serial, speed, address=i) for i, (serial, speed) in enumerate(made)])
    with pytest.raises(UserError, match=message):
        checks.find_cameras(rig(3))


def test_a_machine_without_libusb_gets_the_package_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(**_: Any) -> list[Any]:
        raise usb.core.NoBackendError("No backend available")

    monkeypatch.setattr(usb.core, "find", find)
    with pytest.raises(UserError, match="apt install libusb-1.0-0"):
        checks.find_cameras(rig(1))


@pytest.mark.parametrize(("limit", "refused"), [("16\n", True), ("36", False), ("0", False), (None, False)])
def test_kernel_memory_for_the_reads_in_flight(tmp_path: Path, limit: str | None, refused: bool) -> None:
    file = tmp_path / "usbfs_memory_mb"
    if limit is not None:
        file.write_text(limit)
    found = checks.check_usb_memory(ARRAY, file)  # 9 x 16 x 256 KiB
    expected = "usbfs_memory_mb: expected 36 MiB for the reads in flight, found 16 MiB; run: echo 128 | sudo tee /sys/"
    assert str(found).startswith(expected) if refused else found is None


@pytest.mark.parametrize(("free_kb", "continuous", "refused"), [(300_000, False, True), (9_000_000, False, False)])
def test_free_memory(free_kb: int, continuous: bool, refused: bool) -> None:
    found = checks.check_memory(ARRAY, 5.0, continuous, free_kb * 1024)
    assert ("--seconds" in str(found)) if refused else found is None


def test_a_clip_with_tags_needs_room_for_its_pixels_too() -> None:
    tagged = replace(ARRAY, layout="tagged-rows")
    assert checks.check_memory(ARRAY, 10.0, False, 450_000 * 1024) is None
    assert checks.check_memory(tagged, 10.0, False, 450_000 * 1024) is not None


def test_disk_space(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(checks.shutil, "disk_usage", lambda _: SimpleNamespace(free=50 << 20))
    assert checks.check_disk(ARRAY, 1.0, tmp_path / "not" / "yet" / "there") is None
    found = str(checks.check_disk(ARRAY, 20.0, tmp_path))
    assert "0.1 GB of free disk space, found 0.1 GB; free some space" in found


def test_a_ring_is_larger_than_the_reads_in_flight() -> None:
    assert checks.check_ring(replace(ARRAY, ring_seconds=30.0)) is None
    found = str(checks.check_ring(replace(ARRAY, ring_seconds=0.5)))  # of 600 kB/s
    assert found.startswith("rig test: expected a buffer of 14 s or more") and "raise --buffer-s" in found
    assert checks.check_ring(ARRAY) is None, "the one chosen from the free memory has room"


def test_all_of_a_machines_problems_are_listed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(checks, "check_usb_memory", lambda _: UserError("usb"))
    monkeypatch.setattr(checks, "check_memory", lambda *_: UserError("memory"))
    monkeypatch.setattr(checks, "check_disk", lambda *_: None)
    ring = replace(ARRAY, ring_seconds=30.0)
    assert [str(e) for e in checks.check_machine(ring, 1.0, tmp_path)] == ["usb", "memory"]
    ring = replace(ARRAY, ring_seconds=0.5)
    found = checks.check_machine(ring, 1.0, tmp_path, continuous=True, emulated=True)
    assert [str(e)[:6] for e in found] == ["memory", "rig te"]


class Bus:
    """A device that answers each read with the next of `answers`: bytes, or an exception."""

    def __init__(self, *answers: Any) -> None:
        self.answers, self.written, self.claimed = list(answers), [], []
        self.backend: Any = SimpleNamespace()
        self.busy: usb.core.USBError | None = None

    def read(self, endpoint: int, into: array.array[int], timeout_ms: int) -> int:
        assert isinstance(into, array.array) and endpoint == 0x82
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        into[: len(answer)] = array.array("B", answer)
        return len(answer)

    def write(self, endpoint: int, data: bytes, timeout_ms: int) -> None:
        self.written.append((endpoint, data))
        if data == b"refused":
            raise usb.core.USBError("Pipe error", None, errno.EPIPE)

    def get_active_configuration(self) -> None:
        if self.busy:
            raise self.busy

    def set_configuration(self) -> None:
        self.claimed.append("configuration")

    def is_kernel_driver_active(self, interface: int) -> bool:
        raise NotImplementedError


def opened(monkeypatch: pytest.MonkeyPatch, bus: Bus, queued: bool | None = None, **changes: Any) -> transport.Link:
    monkeypatch.setattr(usb.util, "claim_interface", lambda device, i: device.claimed.append(i))
    monkeypatch.setattr(usb.util, "dispose_resources", lambda device: device.claimed.clear())
    profile = rig(1)
    camera = replace(profile.cameras[0], control_interface=3, **changes)
    link = transport.open_link(bus, camera, profile, queued)
    assert isinstance(link, transport.Link)
    return link


@pytest.mark.parametrize(
    ("answer", "n", "status"),
    [
        (bytes(range(8)), 8, OK),
        (b"abc", 3, SHORT),
        (usb.core.USBTimeoutError("late", None, errno.ETIMEDOUT), 0, TIME_OUT),
        (usb.core.USBError("pipe", None, errno.EPIPE), 0, STALL),
        (usb.core.USBError("io", None, errno.EIO), 0, STALL),
        (usb.core.USBError("babble", None, errno.EOVERFLOW), 0, OVERFLOW),
        (usb.core.USBError("gone", None, errno.ENODEV), 0, UNPLUGGED),
    ],
)
def test_a_single_read_ends_as_pyusb_says(answer: Any, n: int, status: str) -> None:
    reads = SingleReads(Bus(answer), 0x82, 8, 10_000)
    into = np.zeros(8, np.uint8)
    assert reads.wait(0) is None
    reads.submit(into)
    assert reads.in_flight == 1
    done = reads.wait(0)
    assert done is not None and (done.bytes, done.status) == (n, status)
    assert into[:n].tobytes() == (answer if n else b"") and reads.in_flight == 0


def test_bytes_before_a_time_out_are_good() -> None:
    reads = SingleReads(Bus(b"abc"), 0x82, 8, 0)
    reads.submit(np.zeros(8, np.uint8))
    done = reads.wait(0)
    assert done is not None and (done.bytes, done.status) == (3, TIME_OUT)


def test_a_link_starts_stops_and_drains_its_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    late = usb.core.USBTimeoutError("late", None, errno.ETIMEDOUT)
    bus = Bus(bytes(1024), bytes(300), late)
    link = opened(monkeypatch, bus, start=(b"a", b"b"), stop=(b"refused",))
    assert bus.claimed == [0, 3] and not link.queued and link.restartable and link.camera.serial == "S0"
    link.start()
    link.stop()  # a camera that refuses it is left as it is
    assert bus.written == [(0x02, b"a"), (0x02, b"b"), (0x02, b"refused")]
    assert link.drain() == 1324
    link.close()
    assert not bus.claimed


def test_a_refused_start_sequence_names_the_keys_to_check(monkeypatch: pytest.MonkeyPatch) -> None:
    link = opened(monkeypatch, Bus(), start=(b"refused",))
    with pytest.raises(UserError, match=r"camera cam_00 \(serial S0\): .* Pipe error while it was started; check"):
        link.start()


@pytest.mark.parametrize(
    ("number", "message"),
    [(errno.EACCES, 'found no permission; put .* ATTR{idVendor}=="0403"'), (errno.ENODEV, "plug the camera in again")],
)
def test_a_device_that_cannot_be_opened(monkeypatch: pytest.MonkeyPatch, number: int, message: str) -> None:
    bus = Bus()
    bus.busy = usb.core.USBError("No", None, number)
    with pytest.raises(UserError, match=message):
        opened(monkeypatch, bus)


def test_a_device_without_configuration_gets_one(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = Bus()
    bus.busy = usb.core.USBError("Configuration not set")
    opened(monkeypatch, bus)
    assert bus.claimed[0] == "configuration"


def _library(*names: str) -> SimpleNamespace:
    return SimpleNamespace(**dict.fromkeys(names))


ALL = tuple(queued._FUNCTIONS)


@pytest.mark.parametrize(
    ("backend", "context", "reason"),
    [
        (SimpleNamespace(), None, "backend SimpleNamespace has no lib and no ctx"),
        (SimpleNamespace(ctx=1, lib=_library(*ALL[1:])), None, "this libusb has no libusb_alloc_transfer"),
        (SimpleNamespace(ctx=1, lib=_library(*ALL)), None, "this version of pyusb keeps its libusb handle elsewhere"),
        (SimpleNamespace(ctx=1, lib=_library(*ALL)), SimpleNamespace(managed_open=object), "handle elsewhere"),
        (SimpleNamespace(ctx=1, lib=_library(*ALL)), SimpleNamespace(managed_open=lambda: _library("handle")), None),
    ],
)
def test_a_pyusb_that_hides_its_handle_is_read_without_a_queue(backend: Any, context: Any, reason: str | None) -> None:
    found = queued.unavailable(SimpleNamespace(backend=backend, _ctx=context))
    assert (reason in found) if reason and found else found is reason


def test_insisting_on_a_queue_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="expected queued reads, found the pyusb backend SimpleNamespace has no lib"):
        opened(monkeypatch, Bus(), queued=True)


def test_a_backend_with_its_own_queue_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = Bus()
    bus.backend = SimpleNamespace(open_transfers=lambda *a: Completion(0, 0, repr(a[1:])))
    link = opened(monkeypatch, bus)
    assert link.queued and link.transfers() == Completion(0, 0, "(130, 1024, 3)")
    single = opened(monkeypatch, bus, queued=False)
    assert not single.queued and isinstance(single.transfers(), SingleReads)
