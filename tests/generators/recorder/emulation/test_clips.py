"""Recordings of emulated cameras: equal to the scene, with faults, and with a slow consumer."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from emulated_rig import BLOCK, N, emulate, profile_of
from recorder_rig import FRAME, HEIGHT, TICKS, WIDTH, check_identical, check_recording, finish, record, source_scene

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.generators.recorder.capture import capture
from spike4dgs.generators.recorder.clip_files import StreamFiles
from spike4dgs.generators.recorder.emulation import ports as emulator
from spike4dgs.generators.recorder.emulation.camera import Fault
from spike4dgs.generators.recorder.emulation.ports import EmulatedReads
from spike4dgs.generators.recorder.frames.clip import CameraClip
from spike4dgs.generators.recorder.frames.layouts import make_layout
from spike4dgs.generators.recorder.record import open_links
from spike4dgs.generators.recorder.usb.reads import Completion


@pytest.fixture(scope="module")
def nine(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return source_scene(tmp_path_factory.mktemp("nine") / "scene")


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return source_scene(tmp_path_factory.mktemp("two") / "scene", cameras=2, ticks=N)


@pytest.mark.parametrize(("layout", "transfers"), [("plain", 4), ("plain", 1), ("tagged-rows", 4), ("line-tagged", 1)])
def test_a_recording_of_nine_cameras_is_the_scene_that_they_show(
    nine: Scene, layout: str, transfers: int, tmp_path: Path
) -> None:
    profile = profile_of(nine, layout=layout, transfers=transfers)
    clip = record(tmp_path / "clip", profile, emulate(nine, profile), TICKS)
    assert clip.complete
    assert clip.sync == ("frame tags" if layout == "tagged-rows" else "arrival times")
    check_identical(tmp_path / "clip", nine)


def test_cameras_that_see_the_scene_upside_down_record_it_upright(two: Scene, tmp_path: Path) -> None:
    profile = profile_of(two)
    first, second = profile.cameras
    profile = replace(profile, cameras=(replace(first, rows="top-down"), replace(second, mirrored=True)))
    record(tmp_path / "clip", profile, emulate(two, profile), N)
    check_identical(tmp_path / "clip", two)


def test_cameras_that_send_from_power_on_agree_on_a_tick(two: Scene) -> None:
    profile = profile_of(two, layout="tagged-rows")
    profile = replace(profile, cameras=tuple(replace(c, start=(), stop=()) for c in profile.cameras))
    clip = capture(profile, open_links(profile, emulate(two, profile)), N / 20000)
    assert clip.complete and clip.sync == "frame tags"
    frames, origins = make_layout("tagged-rows", WIDTH, HEIGHT), set()
    for camera in clip.cameras:
        payload = np.empty((N, FRAME), np.uint8)
        frames.unpack(camera.frames, payload)
        counts = frames.counts(camera.frames)
        np.testing.assert_array_equal(payload, two.stream(camera.camera).packed[counts % N])
        origins.add(int(counts[0]))
    assert len(origins) == 1


def fail(scene: Scene, out: Path, fault: Fault, **changes: object) -> CameraClip:
    """Record with a fault of cam_01, check that cam_00 is complete, and return cam_01's clip."""
    profile = profile_of(scene, **changes)
    clip = record(out, profile, emulate(scene, profile, fault), N)
    check_recording(out, scene, clip)
    sound, failed = clip.cameras
    assert not sound.gaps and sound.stats.end == "ok"
    with pytest.raises(UserError, match="pass --allow-gaps"):
        open_scene(out)
    return failed


@pytest.mark.parametrize(
    ("kind", "transfers"),
    [*((kind, 4) for kind in ("stall", "overflow", "unplugged", "time-out", "short read")), ("stall", 1)],
)
def test_a_camera_that_fails_keeps_every_earlier_tick(two: Scene, kind: str, transfers: int, tmp_path: Path) -> None:
    silent = {"timeout_ms": 1000} if kind == "time-out" else {}
    failed = fail(two, tmp_path / "clip", Fault("cam_01", kind, 77, 33), transfers=transfers, **silent)
    assert [(g.first_tick, g.ticks, g.reason) for g in failed.gaps] == [(77, N - 77, kind)]
    assert failed.stats.end == kind


def test_a_loss_in_the_first_frame_ends_a_camera_whose_ticks_are_then_unknown(two: Scene, tmp_path: Path) -> None:
    failed = fail(two, tmp_path / "clip", Fault("cam_01", "lost bytes", 0, 10, 30), layout="line-tagged")
    assert [(g.first_tick, g.ticks, g.reason) for g in failed.gaps] == [(0, N, "torn frame")]


@pytest.mark.parametrize("layout", ["plain", "tagged-rows"])
def test_a_short_read_between_frames_loses_nothing(two: Scene, layout: str, tmp_path: Path) -> None:
    profile = profile_of(two, layout=layout)
    clip = record(tmp_path / "clip", profile, emulate(two, profile, Fault("cam_01", "short read", 77)), N)
    assert clip.complete and clip.cameras[1].stats.short_reads == clip.cameras[0].stats.short_reads + 1
    check_recording(tmp_path / "clip", two, clip)


@pytest.mark.parametrize(
    ("lost", "gap"), [(0, []), (1, [(77, 1)]), (168, [(77, 2)]), (5 * 168 - 33, [(77, 5)]), (5 * 168, [(77, 6)])]
)
@pytest.mark.parametrize("kind", ["short read", "lost bytes"])
def test_tags_find_the_next_frame_after_a_loss(
    two: Scene, kind: str, lost: int, gap: list[tuple[int, int]], tmp_path: Path
) -> None:
    profile = profile_of(two, layout="tagged-rows")
    clip = record(tmp_path / "clip", profile, emulate(two, profile, Fault("cam_01", kind, 77, 33, lost)), N)
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

    A read ends when the consumer has received all frames before it. But while the consumer is stuck in read STUCK of
    cam_01, its reads up to LAST end. The ring's SLOTS then hold the reads from STUCK on; those after them have no slot,
    up to the last that was submitted meanwhile, LAST + FLYING.
    """

    def __init__(self, frame_bytes: int, files: StreamFiles) -> None:
        self.frame_bytes, self.files = frame_bytes, files
        self.armed = False
        self.ended = {"cam_00": 0, "cam_01": 0}
        self.had = {"cam_00": 0, "cam_01": 0}  # ticks
        self.stuck, self.behind = threading.Event(), threading.Event()

    @property
    def lost(self) -> tuple[int, int]:
        """First tick without a slot, and the first one after it with a slot."""
        return self.ticks(STUCK + SLOTS), -(-(LAST + FLYING + 1) * BLOCK // self.frame_bytes)

    def ticks(self, reads: int) -> int:
        """Return the number of whole ticks in this many reads."""
        return reads * BLOCK // self.frame_bytes

    def allows(self, camera: str) -> bool:
        n = self.ended[camera]
        if not self.armed:
            return True
        if camera == "cam_01" and n > STUCK and not self.behind.is_set():
            if n > LAST:  # the read that follows LAST's has been submitted
                self.behind.set()
            return n <= LAST and self.stuck.is_set()
        if camera == "cam_01" and LAST < n <= LAST + FLYING + 1:  # these bring no frames
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
def test_a_consumer_slowed_on_purpose_loses_exactly_the_ticks_without_a_slot(
    two: Scene, layout: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    profile = profile_of(two, layout=layout, transfers=FLYING, ring_seconds=0.002)
    monkeypatch.setattr(emulator, "EmulatedReads", SteppedReads)
    links = open_links(profile, emulate(two, profile, paced=False))
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
    failed = clip.cameras[1]
    assert not len(failed.frames) and failed.stats.slots == SLOTS
    assert failed.stats.backlog >= SLOTS - 1, "all but the one that the sink holds"
    check_recording(tmp_path / "clip", two, clip)
    with pytest.raises(
        UserError, match=f"cam_01 from tick {first}, {stop - first} ticks .overflow.; pass --allow-gaps"
    ):
        open_scene(tmp_path / "clip")
