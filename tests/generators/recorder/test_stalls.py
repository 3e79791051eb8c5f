"""A sink or a disk that stalls: nothing is lost while the buffer has room, and beyond it exactly the listed gaps.

The cameras send by the clock, and keep 0.6 s of data while no read is in flight: a reading thread that waited for the
sink would lose bytes unseen, which the emulated cameras count.
"""

from __future__ import annotations

import os
import re
import signal
import threading
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from recorder_rig import check_identical, source_scene

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.cli import main
from spike4dgs.generators.recorder import disk as disk
from spike4dgs.generators.recorder.capture import capture
from spike4dgs.generators.recorder.clip_files import StreamFiles
from spike4dgs.generators.recorder.emulation.array import EmulatedArray, camera_profile
from spike4dgs.generators.recorder.emulation.ports import emulated_ports
from spike4dgs.generators.recorder.frames.clip import CameraClip, Clip, Sink
from spike4dgs.generators.recorder.record import _interruptible, open_links
from spike4dgs.generators.recorder.resources import real_time
from spike4dgs.generators.recorder.rig_profile import RigProfile

WIDTH, HEIGHT, FPS = 80, 40, 10_000
FRAME = WIDTH * HEIGHT // 8  # 4 MB/s a camera
BLOCK, FLYING = 16384, 16  # 66 ms of reads in flight
SOURCE = np.random.default_rng(0).integers(1, 256, (2, 997, FRAME), dtype=np.uint8)  # a prime number of ticks


def rig(buffer_s: float) -> RigProfile:
    cameras = tuple(camera_profile(f"cam_{i:02d}", f"S{i}", "secondary" if i else "primary") for i in range(2))
    return RigProfile(
        "stalls", WIDTH, HEIGHT, "plain", cameras, FPS, transfer_bytes=BLOCK, transfers=FLYING, ring_seconds=buffer_s
    )


@dataclass
class StallingSink:
    """Passes frames on to `sink`; waits for `seconds` before the first frames of cam_00 from tick 500 on."""

    sink: Sink
    seconds: float
    during: Callable[[], None]  # called when it begins to wait
    stalled: threading.Event = field(default_factory=threading.Event)
    peak: int = 0  # bytes in use, as tracemalloc counts them

    def __call__(self, camera: str, first_tick: int, frames: UInt8) -> None:
        if camera == "cam_00" and first_tick >= 500 and not self.stalled.is_set():
            self.stalled.set()
            self.during()
            time.sleep(self.seconds)
        self.sink(camera, first_tick, frames)
        self.peak = tracemalloc.get_traced_memory()[1]


def run(
    folder: Path,
    seconds: float,
    stall_s: float,
    buffer_s: float,
    during: Callable[[], None] = lambda: None,
    stop: threading.Event | None = None,
) -> tuple[Clip, int]:
    """Record, and check that every tick is either the camera's own in the file, or zeros within a gap.

    Return the clip and the most memory in use, if it is traced.
    """
    profile = rig(buffer_s)
    array = EmulatedArray(profile, {f"cam_{i:02d}": SOURCE[i] for i in range(2)}, memory_bytes=int(0.6 * FPS * FRAME))
    links = open_links(profile, emulated_ports(array))
    with StreamFiles(folder, profile, round(seconds * FPS)) as files:
        sink = StallingSink(files.write, stall_s, during)
        with real_time():  # other tests beside this one must not cost data
            clip = capture(profile, links, seconds, sink=sink, stop=stop)
        assert not files.flush(clip.n_ticks)
        assert sink.stalled.is_set()
        for source, camera in zip(SOURCE, clip.cameras, strict=True):
            check_file(folder / f".{camera.camera}.dat.part", source, camera, clip.n_ticks)
    assert [c.lost_bytes for c in array.cameras.values()] == [0, 0], "no camera was ever without a read"
    assert not [t for t in threading.enumerate() if t.name == "delivery"]
    return clip, sink.peak


def check_file(path: Path, source: UInt8, camera: CameraClip, n_ticks: int) -> None:
    expected = np.resize(source, (n_ticks, FRAME)).copy()
    for gap in camera.gaps:
        expected[gap.first_tick : gap.stop_tick] = 0
    assert path.read_bytes() == expected.tobytes()
    assert camera.stats.lost_ticks == sum(g.ticks for g in camera.gaps)
    zeros = np.fromfile(path, np.uint8).reshape(n_ticks, FRAME).any(axis=1)
    assert camera.stats.lost_ticks + int(zeros.sum()) == n_ticks, "what was sent is written, or is in a gap"


def test_a_stall_shorter_than_the_buffer_loses_nothing(tmp_path: Path) -> None:
    stall_s = 1.2  # twice as long as the cameras themselves keep data
    clip, _ = run(tmp_path / "clip", stall_s + 0.3, stall_s, buffer_s=stall_s + 1.0)
    assert clip.complete and not clip.interrupted and clip.n_ticks == round((stall_s + 0.3) * FPS)
    waited = max(c.stats.backlog for c in clip.cameras) * BLOCK / (FPS * FRAME)
    assert waited > 0.7 * stall_s, "the data of the stall waited in memory"


def test_a_stall_longer_than_the_buffer_is_a_gap_and_takes_no_more_memory(tmp_path: Path) -> None:
    buffer_s, stall_s = 0.2, 1.2
    slots = int(np.ceil(buffer_s * FPS * FRAME / BLOCK))
    tracemalloc.start()
    try:
        clip, peak = run(tmp_path / "clip", stall_s + 0.4, stall_s, buffer_s)
    finally:
        tracemalloc.stop()
    rings = 2 * (slots + 1) * BLOCK
    assert rings < peak < rings + (2 << 20) < 2 * stall_s * FPS * FRAME, "what the cameras sent would not fit"
    for camera in clip.cameras:
        assert camera.stats.slots == slots and camera.stats.backlog <= slots
        assert {g.reason for g in camera.gaps} == {"overflow"}
        first, stop = camera.gaps[0].first_tick, camera.gaps[-1].stop_tick
        assert first >= 500 + (slots - FLYING - 2) * BLOCK // FRAME, "the buffer is used up first"
        assert camera.stats.lost_ticks >= (stall_s - buffer_s) * FPS - 2 * BLOCK // FRAME
        assert stop < clip.n_ticks, "later ticks are kept"


def test_ctrl_c_during_a_stall_ends_the_reading_and_keeps_what_is_there(tmp_path: Path) -> None:
    press = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    with _interruptible() as stop:
        clip, _ = run(tmp_path / "clip", 30.0, 2.0, buffer_s=4.0, during=press.start, stop=stop)
    assert clip.interrupted and clip.complete
    assert 500 < clip.n_ticks < 2.0 * FPS, "the cameras were read until Ctrl-C, not until the sink returned"


def test_a_disk_that_stalls_within_a_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stall_s = 0.3
    scene = source_scene(tmp_path / "scene", cameras=2, ticks=12_000)  # 0.6 s, 1.4 MB a camera
    write, calls = os.pwrite, iter(range(10**6))

    def stall(fd: int, data: memoryview, at: int) -> int:
        if next(calls) % 20 == 5:  # every twentieth write takes long
            time.sleep(stall_s)
        return write(fd, data, at)

    monkeypatch.setattr(disk, "BUFFER_BYTES", 16 * 4096)
    monkeypatch.setattr(disk.os, "pwrite", stall)
    assert main(["record", "--emulate", str(scene.root), "--out", str(tmp_path / "clip"), "--continuous"]) == 0
    check_identical(tmp_path / "clip", scene)
    shown = capsys.readouterr().out
    assert "of all cameras while the disk stalls" in shown
    took = re.search(r"the disk took ([\d.]+)", shown)
    assert took and stall_s <= float(took[1])  # one write, longer on a busy machine
