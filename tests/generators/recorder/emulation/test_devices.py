"""Emulated cameras and their backend: the data that they send, and their faults."""

from __future__ import annotations

import errno
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import usb.core
import usb.util
from emulated_rig import N, emulate, profile_of
from hypothesis import given, settings
from hypothesis import strategies as st
from recorder_rig import FRAME, HEIGHT, WIDTH, source_scene

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.generators.recorder.emulation import camera as emulated_camera
from spike4dgs.generators.recorder.emulation.array import EmulatedArray, scene_streams
from spike4dgs.generators.recorder.emulation.camera import EmulatedCamera, Fault
from spike4dgs.generators.recorder.frames.layouts import make_layout
from spike4dgs.generators.recorder.frames.orientation import orient


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return source_scene(tmp_path_factory.mktemp("two") / "scene", cameras=2, ticks=N)


def camera_of(scene: Scene, *faults: Fault, layout: str = "plain", **options: object) -> EmulatedCamera:
    profile = profile_of(scene, layout=layout)
    source = scene.stream("cam_00").packed
    return EmulatedCamera(profile.cameras[0], profile, source, faults=faults, **options)  # type: ignore[arg-type]


# The data of a camera.


@settings(max_examples=40, deadline=None)
@given(
    layout=st.sampled_from(["plain", "tagged-rows", "line-tagged"]),
    sizes=st.lists(st.integers(1, 5000), min_size=1, max_size=8),
    losses=st.lists(
        st.tuples(
            st.sampled_from(["lost bytes", "short read"]), st.integers(0, 90), st.integers(0, 119), st.integers(0, 300)
        ),
        max_size=4,
    ),
)
def test_reads_of_any_size_bring_the_stream_less_the_lost_bytes(
    two: Scene, layout: str, sizes: list[int], losses: list[tuple[str, int, int, int]]
) -> None:
    faults = [Fault("cam_00", kind, tick, offset, lost, start=0) for kind, tick, offset, lost in losses]
    camera = camera_of(two, *faults, layout=layout)
    frames = make_layout(layout, WIDTH, HEIGHT)
    ticks = np.resize(two.stream("cam_00").packed, (600, FRAME))
    wire = frames.pack(ticks).reshape(-1)
    camera.begin(0.0)
    at = 0
    ahead = sorted(faults, key=lambda f: f.tick * frames.frame_bytes + f.offset)
    for size in sizes:
        expected, status = bytearray(), "ok"  # byte by byte: the slow twin
        while len(expected) < size:
            if ahead and ahead[0].tick * frames.frame_bytes + ahead[0].offset <= at:
                fault = ahead.pop(0)
                at += fault.lost
                if fault.kind == "short read":
                    status = "short read"
                    break
                continue
            expected.append(wire[at])
            at += 1
        into = np.zeros(size, np.uint8)
        assert camera.read(into) == (len(expected), status)
        assert into[: len(expected)].tobytes() == bytes(expected)


@pytest.mark.parametrize("layout", ["plain", "tagged-rows", "line-tagged"])
@pytest.mark.parametrize(("rows", "mirrored"), [("bottom-up", False), ("top-down", False), ("top-down", True)])
def test_a_camera_sends_its_image_as_its_profile_says(two: Scene, layout: str, rows: str, mirrored: bool) -> None:
    profile = profile_of(two, layout=layout)
    source = two.stream("cam_00").packed
    camera = EmulatedCamera(replace(profile.cameras[0], rows=rows, mirrored=mirrored), profile, source)
    frames = make_layout(layout, WIDTH, HEIGHT)
    raw, payload = np.empty((10, frames.frame_bytes), np.uint8), np.empty((10, FRAME), np.uint8)
    camera.begin(0.0)
    assert camera.read(raw.reshape(-1)) == (raw.size, "ok")
    frames.unpack(raw, payload)
    np.testing.assert_array_equal(orient(payload, WIDTH, HEIGHT, rows == "top-down", mirrored), source[:10])
    assert frames.counts(raw).tolist() == (list(range(10)) if frames.count_tags else [0] * 10)


class Clock:
    """A clock that tests set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(emulated_camera, "time", SimpleNamespace(monotonic=lambda: self.now))

    def set_ticks(self, ticks: float) -> None:
        self.now = 100.0 + ticks / 20000 + 1e-9


def test_a_paced_camera_ends_a_read_when_its_last_byte_was_made(two: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    camera, into = camera_of(two, ticks_per_s=20000), np.zeros(10 * FRAME, np.uint8)
    assert camera.due_s(1) == float("inf") and camera.read(into) is None
    camera.begin(clock.now)
    assert camera.due_s(len(into)) == pytest.approx(100.0 + 10 / 20000)
    clock.set_ticks(9.99)
    assert camera.read(into) is None and camera.ended(3, len(into)) == 0
    clock.set_ticks(25)
    assert camera.ended(3, len(into)) == 2
    assert camera.read(into) == (len(into), "ok") and camera.ended(2, len(into)) == 1
    assert camera.read(into) == (len(into), "ok")
    assert camera.read(into, cut=True) == (5 * FRAME, "cancelled")
    np.testing.assert_array_equal(into[: 5 * FRAME], two.stream("cam_00").packed[20:25].reshape(-1))
    clock.set_ticks(40)
    assert camera.read(into) == (len(into), "ok")
    np.testing.assert_array_equal(into, two.stream("cam_00").packed[25:35].reshape(-1))


def test_a_camera_without_reads_in_flight_loses_whole_frames(two: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    camera = camera_of(two, layout="tagged-rows", ticks_per_s=20000, memory_bytes=3 * 168 + 50)
    frames = make_layout("tagged-rows", WIDTH, HEIGHT)
    assert frames.frame_bytes == 168
    camera.begin(clock.now)
    clock.set_ticks(20.5)
    camera.lose_unread(5 * 168)  # 5 frames are asked for and 3 more fit; tick 20 is the next whole one
    assert camera.lost_bytes == 12 * 168
    camera.lose_unread(5 * 168)
    assert camera.lost_bytes == 12 * 168, "once"
    clock.set_ticks(60)
    raw = np.zeros((12, 168), np.uint8)
    assert camera.read(raw.reshape(-1)) == (raw.size, "ok")
    assert frames.counts(raw).tolist() == [*range(8), 20, 21, 22, 23]


@settings(max_examples=30, deadline=None)
@given(
    steps=st.lists(st.tuples(st.integers(0, 400), st.integers(1, 700)), min_size=1, max_size=12),
    memory=st.integers(0, 700),
)
def test_after_any_loss_the_rest_are_whole_frames_in_order(
    two: Scene, steps: list[tuple[int, int]], memory: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        clock, ticks = Clock(patch), 0.0
        camera = camera_of(two, layout="tagged-rows", ticks_per_s=20000, memory_bytes=memory)
        camera.begin(clock.now)
        got = b""
        for wait, size in steps:  # one read at a time: the camera runs on, the read is submitted and ends
            ticks += wait / 10
            clock.set_ticks(ticks)
            camera.lose_unread(0)
            into = np.zeros(size, np.uint8)
            clock.now = max(clock.now, camera.due_s(size) + 1e-9)
            ticks = (clock.now - 100.0) * 20000
            assert camera.read(into) == (size, "ok")
            got += into.tobytes()
        frames = make_layout("tagged-rows", WIDTH, HEIGHT)
        whole = np.frombuffer(got[: len(got) // 168 * 168], np.uint8).reshape(-1, 168)
        counts = frames.counts(whole)
        assert (np.diff(counts) > 0).all() and (counts >= 0).all()
        assert not len(counts) or (counts[-1] + 1 - len(counts)) * 168 <= camera.lost_bytes


def test_bytes_held_at_a_stop_come_before_the_next_start(two: Scene) -> None:
    camera, into = camera_of(two), np.zeros(3 * FRAME, np.uint8)
    stream = np.resize(two.stream("cam_00").packed, (400, FRAME)).reshape(-1)
    camera.begin(0.0)
    camera.read(into)
    camera.end()
    camera.begin(0.0)
    held = np.zeros(40000, np.uint8)
    assert camera.read(held) == (16384, "short read")
    np.testing.assert_array_equal(held[:16384], stream[3 * FRAME : 3 * FRAME + 16384])
    assert camera.read(into) == (len(into), "ok")
    np.testing.assert_array_equal(into, stream[: len(into)])


# The backend.


def test_secondaries_wait_for_the_trigger_of_the_primary(two: Scene) -> None:
    backend = emulate(two, profile_of(two))
    cameras = backend.emulated.cameras
    assert backend.emulated.write("cam_01", b"start") and not cameras["cam_01"].running
    assert backend.emulated.write("cam_00", b"start") and cameras["cam_00"].running and cameras["cam_01"].running
    assert backend.emulated.write("cam_01", b"stop") and not cameras["cam_01"].running and cameras["cam_00"].running
    assert not backend.emulated.write("cam_01", b"begin")


def test_commands_that_a_camera_does_not_know_stall(two: Scene) -> None:
    device = usb.core.find(backend=emulate(two, profile_of(two)), idProduct=0x601F)
    with pytest.raises(usb.core.USBError) as error:
        device.write(0x01, b"begin")
    assert error.value.errno == errno.EPIPE


@pytest.mark.parametrize(
    ("kind", "number"), [("stall", errno.EPIPE), ("overflow", errno.EOVERFLOW), ("unplugged", errno.ENODEV)]
)
def test_blocking_reads_fail_with_the_errors_of_libusb(two: Scene, kind: str, number: int) -> None:
    backend = emulate(two, profile_of(two), Fault("cam_00", kind, 3, start=0), paced=False)
    device = next(iter(usb.core.find(find_all=True, backend=backend)))
    buffer = usb.util.create_buffer(2 * FRAME)
    with pytest.raises(usb.core.USBTimeoutError):
        device.read(0x82, buffer, 1)
    device.write(0x01, b"start")
    assert device.read(0x82, buffer, 1000) == 2 * FRAME
    for _ in range(2):
        with pytest.raises(usb.core.USBError) as error:
            device.read(0x82, buffer, 1000)
        assert error.value.errno == number
    left = [d.address for d in usb.core.find(find_all=True, backend=backend)]
    assert left == ([2] if kind == "unplugged" else [1, 2])
    if kind == "stall":
        device.clear_halt(0x82)
        assert device.read(0x82, buffer, 1000) == 2 * FRAME


def test_a_blocking_read_that_is_cut_off_returns_the_bytes_so_far(two: Scene) -> None:
    backend = emulate(two, profile_of(two), Fault("cam_00", "time-out", 3, 7, start=0))
    device = next(iter(usb.core.find(find_all=True, backend=backend)))
    device.write(0x01, b"start")
    buffer = usb.util.create_buffer(8 * FRAME)
    assert device.read(0x82, buffer, 50) == 3 * FRAME + 7
    with pytest.raises(usb.core.USBTimeoutError):
        device.read(0x82, buffer, 1)


def test_arrays_that_cannot_be(two: Scene) -> None:
    profile, streams = profile_of(two), scene_streams(two)
    with pytest.raises(UserError, match="emulated camera cam_01: expected a stream of 120 bytes a tick, found none"):
        EmulatedArray(profile, {"cam_00": streams["cam_00"]})
    with pytest.raises(UserError, match="fault: expected one of stall, .*, found 'fire' at cam_00"):
        EmulatedArray(profile, streams, faults=[Fault("cam_00", "fire")])
