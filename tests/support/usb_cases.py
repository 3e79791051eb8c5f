"""Recordings through libusb, from a bus that libumockdev mocks. `test_umockdev.py` runs these in a process of
their own, which has the library preloaded; they are not collected otherwise.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import usb.backend.libusb1 as libusb1
from recorder_rig import FRAME, TICKS, check_identical, check_recording, record, source_scene
from usb_mock import UsbMock

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.generators.recorder.emulation.array import EmulatedArray, scene_profile, scene_streams
from spike4dgs.generators.recorder.emulation.camera import Fault
from spike4dgs.generators.recorder.frames.clip import CameraClip
from spike4dgs.generators.recorder.rig_profile import RigProfile

BLOCK, QUEUED = 1024, 4


@pytest.fixture(scope="module")
def nine(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return source_scene(tmp_path_factory.mktemp("nine") / "scene")


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return source_scene(tmp_path_factory.mktemp("two") / "scene", cameras=2)


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Plug an array in, and return the mock and pyusb's own backend, made after the devices, as libusb needs it."""
    opened: list[tuple[UsbMock, Any]] = []

    def plug_in(scene: Scene, profile: RigProfile, *faults: Fault) -> tuple[UsbMock, Any]:
        mock = UsbMock(EmulatedArray(profile, scene_streams(scene), paced=False, faults=faults)).__enter__()
        monkeypatch.setattr(libusb1, "_lib_object", None)  # pyusb keeps one backend for the life of a process
        backend = libusb1.get_backend()
        opened.append((mock, backend))
        return mock, backend

    yield plug_in
    for mock, backend in opened:
        backend.finalize()
        mock.__exit__(None, None, None)


def profile_of(scene: Scene, **changes: object) -> RigProfile:
    # The time limit is for a busy machine.
    return scene_profile(scene, **({"transfer_bytes": BLOCK, "transfers": QUEUED, "timeout_ms": 60000} | changes))


@contextmanager
def raised(kind: type[Exception]) -> Iterator[list[str]]:
    """Collect the message of an error; pytest.raises would keep devices alive beyond their backend."""
    messages: list[str] = []
    try:
        yield messages
    except kind as e:
        messages.append(str(e))


def test_nine_superspeed_devices_are_found_by_serial_and_recorded_bit_for_bit(
    nine: Scene, bus: Any, tmp_path: Path
) -> None:
    profile = profile_of(nine)
    mock, backend = bus(nine, profile)
    clip = record(tmp_path / "clip", profile, backend, TICKS)
    assert clip.complete and all(c.stats.queued for c in clip.cameras)
    check_identical(tmp_path / "clip", nine)
    assert [d.most_queued for d in mock.devices] == [QUEUED] * 9
    assert not any(d.unhandled for d in mock.devices), "requests that the mock does not know"
    starts = [name for name, command in mock.array.commands if command == b"start"]
    assert starts == 2 * [f"cam_{i:02d}" for i in (1, 2, 3, 4, 5, 6, 7, 8, 0)], "the primary last, twice"


def test_frame_tags_travel_too(two: Scene, bus: Any, tmp_path: Path) -> None:
    profile = profile_of(two, layout="tagged-rows")
    _, backend = bus(two, profile, Fault("cam_01", "lost bytes", 20, 33, lost=3 * 168))
    clip = record(tmp_path / "clip", profile, backend, TICKS)
    check_recording(tmp_path / "clip", two, clip)
    assert [[(g.first_tick, g.ticks) for g in c.gaps] for c in clip.cameras] == [[], [(20, 4)]]


def test_one_read_at_a_time_records_the_same(two: Scene, bus: Any, tmp_path: Path) -> None:
    profile = profile_of(two)
    mock, backend = bus(two, profile)
    clip = record(tmp_path / "clip", profile, backend, TICKS, queued=False)
    assert not any(c.stats.queued for c in clip.cameras)
    check_identical(tmp_path / "clip", two)
    assert [d.most_queued for d in mock.devices] == [1, 1]


def fail(scene: Scene, bus: Any, out: Path, fault: Fault, **changes: object) -> CameraClip:
    """Record with a fault of cam_01, which stops alone. Return its clip."""
    profile = profile_of(scene, **changes)
    _, backend = bus(scene, profile, fault)
    clip = record(out, profile, backend, TICKS)
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
        (
            "duplicate serial",
            "expected one device with this serial number, found several, at bus 1 address [34],",
        ),
        ("high speed", r"expected a SuperSpeed link \(5 Gbit/s\), found High Speed \(480 Mbit/s\); use a USB 3 port"),
    ],
)
def test_an_array_that_differs_from_its_profile_is_not_recorded(
    two: Scene, bus: Any, tmp_path: Path, kind: str, message: str
) -> None:
    profile = profile_of(two)
    _, backend = bus(two, profile, Fault("cam_01", kind))
    with raised(UserError) as errors:
        record(tmp_path / "clip", profile, backend, TICKS)
    assert len(errors) == 1 and re.search(rf"camera cam_01 \(serial EMULATED0001\): {message}", errors[0]), errors
    assert not (tmp_path / "clip").exists()
