"""Emulated cameras and their backend: the data that they send, and their faults."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import usb1
from emulated_rig import N, emulate, profile_of
from hypothesis import given, settings
from hypothesis import strategies as st
from recorder_rig import FRAME, HEIGHT, WIDTH, source_scene

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.spikes.bits import orient
from spike4dgs.generators.recorder.emulation import camera as emulated_camera
from spike4dgs.generators.recorder.emulation.array import EmulatedArray, scene_streams
from spike4dgs.generators.recorder.emulation.camera import EmulatedCamera, Fault
from spike4dgs.generators.recorder.frames.layouts import LAYOUTS, make_layout


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


@pytest.mark.parametrize("layout", LAYOUTS)
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


# The devices.


def test_secondaries_wait_for_the_trigger_of_the_primary(two: Scene) -> None:
    array = EmulatedArray(profile_of(two), scene_streams(two))
    first, second = array.cameras.values()
    assert array.write("cam_01", b"start") and not second.running
    assert array.write("cam_00", b"start") and first.running and second.running
    assert array.write("cam_01", b"stop") and not second.running and first.running


def test_commands_that_a_camera_does_not_know_stall(two: Scene) -> None:
    with pytest.raises(usb1.USBErrorPipe):
        emulate(two, profile_of(two))[0].write(0x01, b"begin", 100)


def test_reads_of_a_camera_that_fails_end_so(two: Scene) -> None:
    port = emulate(two, profile_of(two), Fault("cam_00", "unplugged", 3, start=0), paced=False)[0]
    reads, buffer = port.transfers(0x82, 2 * FRAME, 1), np.zeros(2 * FRAME, np.uint8)
    reads.submit(buffer)
    assert reads.wait(0.001) is None and reads.in_flight == 1, "before the start"
    port.write(0x01, b"start", 100)
    ends = [reads.wait(1)]
    for _ in range(2):
        reads.submit(buffer)
        ends.append(reads.wait(1))
    expected = [(2 * FRAME, "ok"), (FRAME, "unplugged"), (0, "unplugged")]
    assert [(e.bytes, e.status) for e in ends if e is not None] == expected
    for refused in (lambda: port.write(0x01, b"start", 100), lambda: port.open([0])):
        with pytest.raises(usb1.USBErrorNoDevice):
            refused()


def test_arrays_that_cannot_be(two: Scene) -> None:
    profile, streams = profile_of(two), scene_streams(two)
    with pytest.raises(UserError, match="emulated camera cam_01: expected a stream of 120 bytes a tick, found none"):
        EmulatedArray(profile, {"cam_00": streams["cam_00"]})
    with pytest.raises(UserError, match="fault: expected one of stall, .*, found 'fire' at cam_00"):
        EmulatedArray(profile, streams, faults=[Fault("cam_00", "fire")])
