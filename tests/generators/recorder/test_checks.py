"""Checks before a capture, and opening a device: every refusal states a fix."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import usb1
from fake_camera import rig

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.recorder import checks
from spike4dgs.generators.recorder.usb import link as link_module
from spike4dgs.generators.recorder.usb.link import Link, open_link
from spike4dgs.generators.recorder.usb.ports import usb_ports
from spike4dgs.generators.recorder.usb.reads import OK, SHORT, Completion

ARRAY = rig(9, transfer_bytes=262144, transfers=16)


class FakePort:
    """A device; `serial` and `refuses` may be errors, which are raised."""

    def __init__(self, serial: Any = "S0", speed: int = 4, address: int = 1) -> None:
        self.vendor_id, self.product_id, self.speed, self.where = 0x0403, 0x601F, speed, f"bus 2 address {address}"
        self.name, self.refuses, self.ends, self.rest = serial, None, list[Completion](), list[Completion]()
        self.written, self.claimed = list[tuple[int, bytes]](), list[int]()

    def serial(self) -> str:
        if isinstance(self.name, Exception):
            raise self.name
        return str(self.name)

    def open(self, interfaces: Collection[int]) -> None:
        if self.refuses:
            raise self.refuses
        self.claimed += interfaces

    def write(self, endpoint: int, data: bytes, timeout_ms: int) -> None:
        self.written.append((endpoint, data))
        if data == b"refused":
            raise usb1.USBErrorPipe

    def transfers(self, endpoint: int, transfer_bytes: int, depth: int) -> Any:
        assert (endpoint, transfer_bytes) == (0x82, 1024)

        def wait(seconds: float) -> Completion | None:
            return self.ends.pop(0) if self.ends else None

        def cancel() -> list[Completion]:
            return [self.rest.pop(0)] if self.rest else []

        return SimpleNamespace(depth=depth, submit=lambda b: None, wait=wait, cancel=cancel)

    def close(self) -> None:
        self.claimed.clear()


def test_cameras_are_found_by_their_serial_numbers() -> None:
    ports = [FakePort("S2"), FakePort("another"), FakePort("S0", speed=5), FakePort("S1")]
    keyboard = FakePort(ValueError("never asked"))
    keyboard.vendor_id = 0x046D
    assert checks.find_cameras(rig(3), [keyboard, *ports]) == {
        "cam_00": ports[2],
        "cam_01": ports[3],
        "cam_02": ports[0],
    }


@pytest.mark.parametrize(
    ("ports", "message"),
    [
        (["S0"], r"camera cam_01 \(serial S1\), cam_02 \(serial S2\): .* found only the serials S0; check cable"),
        ([], "found only the serials none; check"),
        (["S0", "S1", "S2", "S1"], r"cam_01 \(serial S1\): .* several, at bus 2 address 1, bus 2 address 3; give each"),
        (["S0", ("S1", 3), ("S2", 0)], "cam_01 .*, cam_02 .* SuperSpeed .* High Speed.*, an unknown speed; use"),
        ([usb1.USBErrorAccess()], 'found LIBUSB_ERROR_ACCESS.*; put the line SUBSYSTEM=="usb"'),
    ],
)
def test_an_array_that_is_not_complete_is_refused(ports: list[Any], message: str) -> None:
    made = [d if isinstance(d, tuple) else (d, 4) for d in ports]
    with pytest.raises(UserError, match=message):
        checks.find_cameras(rig(3), [FakePort(serial, speed, address=i) for i, (serial, speed) in enumerate(made)])


def test_a_machine_without_libusb_gets_the_package_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def load() -> None:
        raise OSError("no libusb-1.0.so.0")

    monkeypatch.setattr(usb1, "loadLibrary", load)
    with pytest.raises(UserError, match="apt install libusb-1.0-0"):
        usb_ports()


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


def test_a_clip_of_several_parts_needs_room_for_its_copy() -> None:
    """9 cameras x 10 s x 20 kHz x 30 bytes (with tags 50, 60) beside the reads in flight and 256 MiB."""
    on = replace(ARRAY, cameras=tuple(replace(c, stop=()) for c in ARRAY.cameras))
    for array, need in (
        (ARRAY, 54e6),
        (on, 108e6),
        (replace(ARRAY, layout="tagged-rows"), 180e6),
        (replace(ARRAY, layout="line-tagged"), 108e6),
    ):
        need = round(need) + 9 * 2 * 16 * 262144 + (256 << 20)
        assert checks.check_memory(array, 10.0, False, need) is None
        assert checks.check_memory(array, 10.0, False, need - 1) is not None


def test_disk_space(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(checks.shutil, "disk_usage", lambda _: SimpleNamespace(free=50 << 20))
    assert checks.check_disk(ARRAY, 1.0, tmp_path / "not" / "yet" / "there") is None
    found = str(checks.check_disk(ARRAY, 20.0, tmp_path))
    assert "0.1 GB of free disk space, found 0.1 GB; free some space" in found


def test_all_of_a_machines_problems_are_listed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(checks, "check_usb_memory", lambda _: UserError("usb"))
    monkeypatch.setattr(checks, "check_memory", lambda *_: UserError("memory"))
    monkeypatch.setattr(checks, "check_disk", lambda *_: None)
    assert [str(e) for e in checks.check_machine(ARRAY, 1.0, tmp_path)] == ["usb", "memory"]
    assert [str(e) for e in checks.check_machine(ARRAY, 1.0, tmp_path, emulated=True)] == ["memory"]


def opened(port: FakePort, **changes: Any) -> Link:
    profile = rig(1)
    return open_link(port, replace(profile.cameras[0], control_interface=3, **changes), profile)


def test_a_link_starts_stops_and_drains_its_camera() -> None:
    port = FakePort()
    link = opened(port, start=(b"a", b"b"), stop=(b"refused",))
    assert port.claimed == [0, 3] and link.restartable and link.transfers().depth == 3
    link.start()
    link.stop()  # a camera that refuses it is left as it is
    assert port.written == [(0x02, b"a"), (0x02, b"b"), (0x02, b"refused")]
    port.ends = [Completion(1024, 0, OK), Completion(300, 0, SHORT)]
    port.rest = [Completion(0, 0, "cancelled"), Completion(0, 0, "cancelled"), Completion(7, 0, "cancelled")]
    assert link.drain() and not port.ends and not port.rest, "with what a read has when it is cancelled"
    link.close()
    assert not port.claimed


def test_a_camera_that_was_not_stopped_is_not_drained_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    port = FakePort()
    port.ends = [Completion(1 << 20, 0, OK)] * 100
    assert not opened(port).drain() and len(port.ends) == 36
    monkeypatch.setattr(link_module, "_MOST_DRAIN_S", 0.001)
    slow = FakePort()  # whose reads never fill
    slow.rest = [Completion(7, 0, "cancelled")] * 1_000_000
    assert not opened(slow).drain()


def test_a_refused_start_sequence_names_the_keys_to_check() -> None:
    with pytest.raises(UserError, match=r"camera cam_00 \(serial S0\): .*PIPE.* while it was started; check"):
        opened(FakePort(), start=(b"refused",)).start()


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (usb1.USBErrorAccess, 'found no permission; put .* ATTR{idVendor}=="0403"'),
        (usb1.USBErrorBusy, "found another program holds it; end that program"),
        (usb1.USBErrorNoDevice, "NO_DEVICE.*; plug the camera in again"),
    ],
)
def test_a_device_that_cannot_be_opened(error: type[Exception], message: str) -> None:
    port = FakePort()
    port.refuses = error()
    with pytest.raises(UserError, match=message):
        opened(port)
