"""Recordings through libusb, from a bus that libumockdev mocks. `test_umockdev.py` runs these in a process of
their own, which has the library preloaded; they are not collected otherwise.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import usb.backend.libusb1
from emulated_rig import profile_of as emulated_profile
from recorder_rig import FRAME, TICKS, check_identical, check_recording, record, source_scene
from usb_mock import UsbMock

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.generators.recorder.emulation.array import EmulatedArray, scene_streams
from spike4dgs.generators.recorder.emulation.camera import Fault
from spike4dgs.generators.recorder.frames.clip import CameraClip
from spike4dgs.generators.recorder.rig_profile import RigProfile
from spike4dgs.generators.recorder.usb.ports import UsbPort, usb_ports

QUEUED = 4  # reads of the profile


@pytest.fixture(scope="module")
def nine(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return source_scene(tmp_path_factory.mktemp("nine") / "scene")


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return source_scene(tmp_path_factory.mktemp("two") / "scene", cameras=2)


@pytest.fixture
def bus() -> Iterator[Any]:
    """Plug an array in, and return the mock and the devices that libusb finds then."""
    with ExitStack() as mocks:

        def plug_in(scene: Scene, profile: RigProfile, *faults: Fault) -> tuple[UsbMock, list[UsbPort]]:
            mock = UsbMock(EmulatedArray(profile, scene_streams(scene), paced=False, faults=faults))
            mocks.enter_context(mock)
            usb.backend.libusb1._lib_object = None  # PyUSB's context of a process outlives a mocked bus
            ports = usb_ports()
            mocks.callback(lambda: ports[0]._context.close())  # before the devices go
            return mock, ports

        yield plug_in


profile_of = partial(emulated_profile, timeout_ms=60000)  # for a busy machine


def test_nine_superspeed_devices_are_found_by_serial_and_recorded_bit_for_bit(
    nine: Scene, bus: Any, tmp_path: Path
) -> None:
    profile = profile_of(nine)
    mock, ports = bus(nine, profile)
    clip = record(tmp_path / "clip", profile, ports, TICKS)
    assert clip.complete
    check_identical(tmp_path / "clip", nine)
    assert [d.most_queued for d in mock.devices] == [QUEUED] * 9
    assert not any(d.unhandled for d in mock.devices), "requests that the mock does not know"
    starts = [name for name, command in mock.array.commands if command == b"start"]
    assert starts == 2 * [f"cam_{i:02d}" for i in (1, 2, 3, 4, 5, 6, 7, 8, 0)], "the primary last, twice"


def test_frame_tags_travel_too(two: Scene, bus: Any, tmp_path: Path) -> None:
    profile = profile_of(two, layout="tagged-rows")
    _, ports = bus(two, profile, Fault("cam_01", "lost bytes", 20, 33, lost=3 * 168))
    clip = record(tmp_path / "clip", profile, ports, TICKS)
    check_recording(tmp_path / "clip", two, clip)
    assert [[(g.first_tick, g.ticks) for g in c.gaps] for c in clip.cameras] == [[], [(20, 4)]]


def test_one_read_at_a_time_records_the_same(two: Scene, bus: Any, tmp_path: Path) -> None:
    profile = profile_of(two, transfers=1)
    mock, ports = bus(two, profile)
    record(tmp_path / "clip", profile, ports, TICKS)
    check_identical(tmp_path / "clip", two)
    assert [d.most_queued for d in mock.devices] == [1, 1]


def fail(scene: Scene, bus: Any, out: Path, fault: Fault, **changes: object) -> CameraClip:
    """Record with a fault of cam_01, which stops alone. Return its clip."""
    profile = profile_of(scene, **changes)
    _, ports = bus(scene, profile, fault)
    clip = record(out, profile, ports, TICKS)
    check_recording(out, scene, clip)
    sound, failed = clip.cameras
    assert not sound.gaps and sound.stats.end == "ok"
    return failed


@pytest.mark.parametrize("kind", ["stall", "overflow", "unplugged", "short read"])
def test_a_camera_that_fails_keeps_every_earlier_tick(two: Scene, bus: Any, tmp_path: Path, kind: str) -> None:
    failed = fail(two, bus, tmp_path / "clip", Fault("cam_01", kind, 30, 33))
    assert [(g.first_tick, g.ticks, g.reason) for g in failed.gaps] == [(30, TICKS - 30, kind)]
    assert failed.stats.end == kind


def test_a_short_read_between_frames_loses_nothing(two: Scene, bus: Any, tmp_path: Path) -> None:
    failed = fail(two, bus, tmp_path / "clip", Fault("cam_01", "short read", 30))
    assert not failed.gaps and failed.stats.short_reads == 1


def test_a_camera_that_falls_silent_keeps_every_earlier_tick(two: Scene, bus: Any, tmp_path: Path) -> None:
    failed = fail(two, bus, tmp_path / "clip", Fault("cam_01", "time-out", 30, 33), timeout_ms=2000)
    assert [(g.first_tick, g.ticks, g.reason) for g in failed.gaps] == [(30, TICKS - 30, "time-out")]
    assert failed.stats.bytes == 30 * FRAME + 33


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", "expected a device with this serial number, found only the serials EMULATED0000; check cable"),
        ("duplicate serial", "expected one device with this serial number, found several, at bus 1 address [34],"),
        ("high speed", r"expected a SuperSpeed link \(5 Gbit/s\), found High Speed \(480 Mbit/s\); use a USB 3 port"),
    ],
)
def test_an_array_that_differs_from_its_profile_is_not_recorded(
    two: Scene, bus: Any, tmp_path: Path, kind: str, message: str
) -> None:
    profile = profile_of(two)
    _, ports = bus(two, profile, Fault("cam_01", kind))
    with pytest.raises(UserError, match=rf"camera cam_01 \(serial EMULATED0001\): {message}"):
        record(tmp_path / "clip", profile, ports, TICKS)
    assert not (tmp_path / "clip").exists()
