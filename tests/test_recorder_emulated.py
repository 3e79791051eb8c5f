"""Emulated cameras: they send what they should, fail as told, and a recording of them is the scene that they show."""

from __future__ import annotations

import errno
import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import usb.core
import usb.util
from hypothesis import given, settings
from hypothesis import strategies as st
from recorder_rig import FRAME, HEIGHT, TICKS, WIDTH, check_identical, check_recording, finish, record, source_scene

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene import Scene, open_scene
from spike4dgs.generators.recorder import emulated_camera, emulator
from spike4dgs.generators.recorder.capture import capture
from spike4dgs.generators.recorder.checks import find_cameras
from spike4dgs.generators.recorder.clip import CameraClip
from spike4dgs.generators.recorder.clip_files import StreamFiles
from spike4dgs.generators.recorder.emulated_array import EmulatedArray, scene_profile, scene_streams
from spike4dgs.generators.recorder.emulated_camera import EmulatedCamera, Fault, UInt8
from spike4dgs.generators.recorder.emulator import EmulatedBackend, EmulatedReads
from spike4dgs.generators.recorder.layouts import make_layout, orient
from spike4dgs.generators.recorder.profile import RigProfile
from spike4dgs.generators.recorder.reads import Completion
from spike4dgs.generators.recorder.transport import open_link

BLOCK = 1024
N = 200  # ticks of the clips with faults


@pytest.fixture(scope="module")
def nine(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return source_scene(tmp_path_factory.mktemp("nine") / "scene")


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return source_scene(tmp_path_factory.mktemp("two") / "scene", cameras=2, ticks=N)


def profile_of(scene: Scene, **changes: object) -> RigProfile:
    # The time limit is for a machine that has other things to do.
    return scene_profile(scene, **({"transfer_bytes": BLOCK, "transfers": 4, "timeout_ms": 20000} | changes))


def emulate(scene: Scene, profile: RigProfile, *faults: Fault, **options: object) -> EmulatedBackend:
    return EmulatedBackend(EmulatedArray(profile, scene_streams(scene), faults=faults, **options))  # type: ignore[arg-type]


def camera_of(scene: Scene, *faults: Fault, layout: str = "plain", **options: object) -> EmulatedCamera:
    profile = profile_of(scene, layout=layout)
    source = scene.stream("cam_00").packed
    return EmulatedCamera(profile.cameras[0], profile, source, faults=faults, **options)  # type: ignore[arg-type]


# What a camera sends.


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
def test_reads_of_any_size_bring_the_stream_less_what_is_lost(
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
        expected, status = bytearray(), "ok"  # byte by byte, as slow as it gets
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
def test_a_camera_sends_its_picture_as_its_profile_says(two: Scene, layout: str, rows: str, mirrored: bool) -> None:
    profile = profile_of(two, layout=layout)
    source = two.stream("cam_00").packed
    camera = EmulatedCamera(replace(profile.cameras[0], rows=rows, mirrored=mirrored), profile, source)
    frames = make_layout(layout, WIDTH, HEIGHT)
    raw, payload = np.empty((10, frames.frame_bytes), np.uint8), np.empty((10, FRAME), np.uint8)
    camera.begin(0.0)
    assert camera.read(raw.reshape(-1)) == (raw.size, "ok")
    counts = frames.unpack(raw, payload)
    np.testing.assert_array_equal(orient(payload, WIDTH, HEIGHT, rows == "top-down", mirrored), source[:10])
    if counts is not None:
        assert counts.tolist() == list(range(10))


class Clock:
    """A clock that is set by hand."""

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
def test_whatever_is_lost_the_rest_are_whole_frames_in_order(
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


def test_what_was_held_at_a_stop_comes_before_the_next_start(two: Scene) -> None:
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


def test_a_blocking_read_that_is_cut_off_returns_what_has_come(two: Scene) -> None:
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


# Recordings of it.


@pytest.mark.parametrize("queued", [True, False])
@pytest.mark.parametrize("layout", ["plain", "tagged-rows", "line-tagged"])
def test_a_recording_of_nine_cameras_is_the_scene_that_they_show(
    nine: Scene, layout: str, queued: bool, tmp_path: Path
) -> None:
    profile = profile_of(nine, layout=layout)
    clip = record(tmp_path / "clip", profile, emulate(nine, profile), TICKS, queued)
    assert clip.complete and all(c.stats.queued == queued for c in clip.cameras)
    assert clip.sync == ("frame tags" if layout == "tagged-rows" else "arrival times")
    check_identical(tmp_path / "clip", nine)


def test_cameras_that_see_the_scene_upside_down_record_it_upright(two: Scene, tmp_path: Path) -> None:
    profile = profile_of(two)
    first, second = profile.cameras
    profile = replace(profile, cameras=(replace(first, rows="top-down"), replace(second, mirrored=True)))
    record(tmp_path / "clip", profile, emulate(two, profile), N)
    check_identical(tmp_path / "clip", two)


def test_cameras_that_send_from_the_moment_they_have_power_agree_on_a_tick(two: Scene) -> None:
    profile = profile_of(two, layout="tagged-rows")
    profile = replace(profile, cameras=tuple(replace(c, start=(), stop=()) for c in profile.cameras))
    backend = emulate(two, profile)
    devices = find_cameras(profile, backend)
    clip = capture(profile, {c.id: open_link(devices[c.id], c, profile) for c in profile.cameras}, N / 20000)
    assert clip.complete and clip.sync == "frame tags"
    frames, origins = make_layout("tagged-rows", WIDTH, HEIGHT), set()
    for camera in clip.cameras:
        payload = np.empty((N, FRAME), np.uint8)
        counts = frames.unpack(camera.frames, payload)
        assert counts is not None
        np.testing.assert_array_equal(payload, two.stream(camera.camera).packed[counts % N])
        origins.add(int(counts[0]))
    assert len(origins) == 1


def fail(scene: Scene, out: Path, fault: Fault, queued: bool, **changes: object) -> CameraClip:
    """Record with a fault of cam_01; checks that cam_00 has everything, and returns cam_01's clip."""
    profile = profile_of(scene, **changes)
    clip = record(out, profile, emulate(scene, profile, fault), N, queued)
    check_recording(out, scene, clip)
    sound, failed = clip.cameras
    assert not sound.gaps and sound.stats.end == "ok"
    with pytest.raises(UserError, match="pass --allow-gaps"):
        open_scene(out)
    return failed


@pytest.mark.parametrize("queued", [True, False])
@pytest.mark.parametrize("kind", ["stall", "overflow", "unplugged"])
def test_a_camera_that_fails_keeps_what_came_before(two: Scene, kind: str, queued: bool, tmp_path: Path) -> None:
    tick, offset = 77, 33
    failed = fail(two, tmp_path / "clip", Fault("cam_01", kind, tick, offset), queued)
    # Only of a queued read does libusb tell how much of it came before it failed.
    first = tick if queued else (tick * FRAME + offset) // BLOCK * BLOCK // FRAME
    assert [(g.first_tick, g.ticks, g.reason) for g in failed.gaps] == [(first, N - first, kind)]
    assert failed.stats.end == kind


@pytest.mark.parametrize("queued", [True, False])
def test_a_camera_that_falls_silent_keeps_all_that_came(two: Scene, queued: bool, tmp_path: Path) -> None:
    failed = fail(two, tmp_path / "clip", Fault("cam_01", "time-out", 77, 33), queued, timeout_ms=1000)
    assert [(g.first_tick, g.ticks, g.reason) for g in failed.gaps] == [(77, N - 77, "time-out")]


@pytest.mark.parametrize("queued", [True, False])
def test_a_short_read_in_a_frame_ends_a_camera_without_tags(two: Scene, queued: bool, tmp_path: Path) -> None:
    failed = fail(two, tmp_path / "clip", Fault("cam_01", "short read", 77, 33), queued)
    assert [(g.first_tick, g.ticks, g.reason) for g in failed.gaps] == [(77, N - 77, "short read")]


@pytest.mark.parametrize(
    ("lost", "gap"), [(0, []), (1, [(77, 1)]), (168, [(77, 2)]), (5 * 168 - 33, [(77, 5)]), (5 * 168, [(77, 6)])]
)
@pytest.mark.parametrize("kind", ["short read", "lost bytes"])
def test_tags_find_the_next_frame_after_a_loss(
    two: Scene, kind: str, lost: int, gap: list[tuple[int, int]], tmp_path: Path
) -> None:
    profile = profile_of(two, layout="tagged-rows")
    backend = emulate(two, profile, Fault("cam_01", kind, 77, 33, lost))
    clip = record(tmp_path / "clip", profile, backend, N)
    check_recording(tmp_path / "clip", two, clip)
    assert [(g.first_tick, g.ticks) for g in clip.cameras[1].gaps] == gap


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", r"camera cam_01 \(serial EMULATED0001\): expected a device with this serial number"),
        ("duplicate serial", r"camera cam_01 \(serial EMULATED0001\): expected one device with this serial number"),
        ("high speed", r"camera cam_01 \(serial EMULATED0001\): expected a SuperSpeed link .* found High Speed"),
    ],
)
def test_arrays_that_are_not_recorded(two: Scene, kind: str, message: str, tmp_path: Path) -> None:
    profile = profile_of(two)
    with pytest.raises(UserError, match=message):
        record(tmp_path / "clip", profile, emulate(two, profile, Fault("cam_01", kind)), N)
    assert not (tmp_path / "clip").exists()


def test_a_camera_that_fails_in_the_rehearsal_is_not_recorded(two: Scene, tmp_path: Path) -> None:
    profile = profile_of(two)
    with pytest.raises(UserError, match="camera cam_01: expected data after its start sequence, found stall"):
        record(tmp_path / "clip", profile, emulate(two, profile, Fault("cam_01", "stall", start=0)), N)
    assert not (tmp_path / "clip").exists()


# A consumer that is too slow.

STUCK, LAST, SLOTS, FLYING = 6, 14, 8, 4  # reads counted from 0


class Steps:
    """Lets reads end one by one, so that the consumer falls behind by a known number of them.

    A read ends when the consumer has had all frames before it. But while the consumer is stuck in read STUCK of cam_01,
    its reads up to LAST end. The ring's SLOTS then hold the reads from STUCK on; those after them have no place, up to
    the last that was submitted meanwhile, LAST + FLYING.
    """

    def __init__(self, frame_bytes: int, files: StreamFiles) -> None:
        self.frame_bytes, self.files = frame_bytes, files
        self.armed = False
        self.ended = {"cam_00": 0, "cam_01": 0}
        self.had = {"cam_00": 0, "cam_01": 0}  # ticks
        self.stuck, self.behind = threading.Event(), threading.Event()

    @property
    def lost(self) -> tuple[int, int]:
        """First tick that finds no place, and the first one after it that does."""
        return self.ticks(STUCK + SLOTS), -(-(LAST + FLYING + 1) * BLOCK // self.frame_bytes)

    def ticks(self, reads: int) -> int:
        """Whole ticks in this many reads."""
        return reads * BLOCK // self.frame_bytes

    def allows(self, camera: str) -> bool:
        n = self.ended[camera]
        if not self.armed:
            return True
        if camera == "cam_01" and n > STUCK and not self.behind.is_set():
            if n > LAST:  # the read that follows LAST's has been submitted
                self.behind.set()
            return n <= LAST and self.stuck.is_set()
        if camera == "cam_01" and LAST < n <= LAST + FLYING + 1:  # these have no frames
            return self.had[camera] >= self.lost[0]
        return self.had[camera] >= self.ticks(n)

    def sink(self, camera: str, first_tick: int, frames: UInt8) -> None:
        self.files.write(camera, first_tick, frames)
        if camera == "cam_01" and first_tick + len(frames) == self.ticks(STUCK + 1):
            self.stuck.set()
            assert self.behind.wait(60)
        self.had[camera] = first_tick + len(frames)


class SteppedReads(EmulatedReads):
    """Reads that end when the steps allow it."""

    steps: Steps

    def wait(self, timeout_s: float) -> Completion | None:
        name = self._camera.profile.id
        if not self.steps.allows(name):
            time.sleep(1e-3)
            return None
        done = super().wait(timeout_s)
        self.steps.ended[name] += self.steps.armed and done is not None
        return done


@pytest.mark.parametrize("layout", ["plain", "tagged-rows"])
def test_a_consumer_slowed_on_purpose_costs_exactly_the_ticks_that_found_no_place(
    two: Scene, layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    profile = profile_of(two, layout=layout, transfers=FLYING, ring_seconds=0.002)
    backend = emulate(two, profile, paced=False)
    monkeypatch.setattr(emulator, "EmulatedReads", SteppedReads)
    devices = find_cameras(profile, backend)
    links = {c.id: open_link(devices[c.id], c, profile) for c in profile.cameras}
    with StreamFiles(tmp_path / "clip", profile, N) as files:
        steps = Steps(make_layout(layout, WIDTH, HEIGHT).frame_bytes, files)
        monkeypatch.setattr(SteppedReads, "steps", steps, raising=False)

        def on_state(state: str) -> None:
            steps.armed = state != "OPEN"

        clip = capture(profile, links, N / 20000, on_state=on_state, sink=steps.sink)
        finish(files, clip)
    first, stop = steps.lost
    assert [[(g.first_tick, g.stop_tick, g.reason) for g in c.gaps] for c in clip.cameras] == [
        [],
        [(first, stop, "overflow")],
    ]
    assert 0 < first < stop < N - 1, "data follow the gap"
    check_recording(tmp_path / "clip", two, clip)
    with pytest.raises(
        UserError, match=f"cam_01 from tick {first}, {stop - first} ticks .overflow.; pass --allow-gaps"
    ):
        open_scene(tmp_path / "clip")
