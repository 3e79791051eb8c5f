"""`speed record`: paced emulated cameras into memory and to disk, with queued reads beside reads one at a time."""

from __future__ import annotations

import argparse
import contextlib
import os
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.timing import show_table
from spike4dgs.generators.recorder.capture import DRAIN, TRIGGERED, capture
from spike4dgs.generators.recorder.checks import find_cameras
from spike4dgs.generators.recorder.clip import Clip
from spike4dgs.generators.recorder.clip_files import StreamFiles
from spike4dgs.generators.recorder.emulated_array import EmulatedArray, camera_profile
from spike4dgs.generators.recorder.emulated_camera import EmulatedCamera
from spike4dgs.generators.recorder.emulator import EmulatedBackend
from spike4dgs.generators.recorder.layouts import PLAIN, UInt8
from spike4dgs.generators.recorder.profile import PRIMARY, SECONDARY, RigProfile
from spike4dgs.generators.recorder.reads import Completion, Transfers
from spike4dgs.generators.recorder.transport import UsbLink, open_link

COLUMNS = (
    "into", "reads", "cameras", "MB/s sent", "frames/s kept", "ticks in gaps", "lost unseen, MB", "wrong frames",
    "no read in flight: mean, ms", "worst, ms", "fullest ring, %",
)  # fmt: skip

_WIDTH, _HEIGHT, _FRAME = 400, 250, 12500
_SOURCE_TICKS = 64  # that each camera sends again and again
_SUSTAINED = 0.9  # of the rate at which frames are sent, including the time until the disk has the last one


@dataclass(frozen=True)
class Load:
    """What is measured: cameras of 400x250 at `fps`, and how they are read."""

    cameras: int
    fps: int
    transfer_bytes: int
    transfers: int
    memory_bytes: int  # that a camera itself has, for the time without a read


@dataclass(frozen=True, eq=False)
class Outcome:
    """A capture of emulated cameras and what the cameras know about it."""

    clip: Clip
    seconds: float  # from the trigger to the last byte, and on the disk where it goes there
    unseen_bytes: int  # that cameras lost because no read was in flight: without tags nobody can tell
    wrong_frames: int  # in the clip, not at their true ticks


class _SentReads:
    """Reads on an emulated camera, stamped when the camera had sent them, not when somebody looked."""

    def __init__(self, inner: Transfers, camera: EmulatedCamera, size: int) -> None:
        self.depth = inner.depth
        self._inner, self._camera, self._size = inner, camera, size
        self._submitted_ns: deque[int] = deque()

    @property
    def in_flight(self) -> int:
        """As the queue says."""
        return self._inner.in_flight

    def submit(self, buffer: UInt8) -> None:
        """Queue a read."""
        self._submitted_ns.append(time.monotonic_ns())
        self._inner.submit(buffer)

    def wait(self, timeout_s: float) -> Completion | None:
        """The oldest read's end."""
        due_s = self._camera.due_s(self._size)  # infinite before the start
        done = self._inner.wait(timeout_s)
        if done is None:
            return None
        sent_ns = max(due_s * 1e9, self._submitted_ns.popleft())
        return Completion(done.bytes, int(min(sent_ns, done.arrival_ns)), done.status)

    def cancel(self) -> list[Completion]:
        """End every read."""
        return self._inner.cancel()


@dataclass(eq=False)
class _Link(UsbLink):
    """A link whose reads tell true times."""

    emulated: EmulatedCamera

    def transfers(self) -> Transfers:
        """Reads with true times."""
        return _SentReads(super().transfers(), self.emulated, self.profile.transfer_bytes)


def record(argv: Sequence[str] = ()) -> int:
    """Measure how many emulated cameras this machine records, into memory and to disk, and how it reads them.

    Each camera sends 400x250 at 20 kHz by the clock, 250 MB/s, through pyusb and the code that reads real ones; the
    emulator's own copying runs on the same processor, and the bus costs nothing. A camera that no read waits for keeps
    what fits into its memory and loses the rest, as real ones do.
    """
    p = argparse.ArgumentParser("spike4dgs speed record", description=record.__doc__)
    p.add_argument("--cameras", type=int, default=9)
    p.add_argument("--seconds", type=float, default=0.5, help="length of a clip in memory")
    p.add_argument("--fps", type=int, default=20000)
    p.add_argument("--transfer-kib", type=int, default=1024, help="size of a read")
    p.add_argument("--transfers", type=int, default=16, help="reads in flight for each camera")
    p.add_argument("--memory-kib", type=int, default=64, help="memory of a camera and its USB bridge")
    p.add_argument("--disk-seconds", type=float, default=2.0, help="length of each recording to disk; 0: none")
    p.add_argument("--disk", type=Path, help="folder for them (default: a temporary one)")
    p.add_argument("--csv", type=Path, help="write the table here too")
    a = p.parse_args(list(argv))
    load = Load(a.cameras, a.fps, a.transfer_kib << 10, a.transfers, a.memory_kib << 10)
    rows = []
    for queued in (True, False):
        outcome = run(load, a.seconds, queued)
        rows.append(_row("memory", load, outcome, queued))
    sustained = 0
    counts = [n for n in (1, 2, 3, 4, 6, 9, 12, 16) if n <= a.cameras] if a.disk_seconds else []
    for n in counts:
        some = Load(n, load.fps, load.transfer_bytes, load.transfers, load.memory_bytes)
        with tempfile.TemporaryDirectory(dir=a.disk) as new:
            outcome = run(some, a.disk_seconds, True, Path(new) / "clip")
        rows.append(_row("disk", some, outcome, True))
        if not outcome.clip.complete or outcome.unseen_bytes or _kept_per_s(outcome) < _SUSTAINED * n * load.fps:
            break
        sustained = n
    mb_s = load.fps * _FRAME / 1e6
    title = f"emulated cameras of {mb_s:g} MB/s, {load.transfers} reads of {a.transfer_kib} KiB, {os.cpu_count()} cores"
    show_table(title, COLUMNS, rows, a.csv)
    if counts:
        print(f"this machine sustains {sustained} camera{'s' * (sustained != 1)} to disk, for {a.disk_seconds:g} s")
    return 0


def run(load: Load, seconds: float, queued: bool, folder: Path | None = None) -> Outcome:
    """Capture `seconds` of paced cameras into memory, or in continuous mode to files in a new `folder`."""
    profile = array_profile(load)
    rng = np.random.default_rng(0)
    sources = {c.id: rng.integers(0, 256, (_SOURCE_TICKS, _FRAME), dtype=np.uint8) for c in profile.cameras}
    array = EmulatedArray(profile, sources, memory_bytes=load.memory_bytes)
    devices = find_cameras(profile, EmulatedBackend(array))
    links = {}
    for camera in profile.cameras:
        link = open_link(devices[camera.id], camera, profile, queued)
        links[camera.id] = _Link(devices[camera.id], camera, profile, link.queued, array.cameras[camera.id])
    times: dict[str, float] = {}

    def note(state: str) -> None:
        if state == DRAIN and folder is not None:
            _flush(folder)
        times[state] = time.monotonic()

    with contextlib.ExitStack() as stack:
        sink = None
        if folder is not None:
            sink = stack.enter_context(StreamFiles(folder, profile, round(seconds * load.fps))).write
        clip = capture(profile, links, seconds, sink=sink, on_state=note)
    wrong = 0
    for c in clip.cameras:
        for i in range(0, len(c.ticks), _SOURCE_TICKS):
            right = sources[c.camera][c.ticks[i : i + _SOURCE_TICKS] % _SOURCE_TICKS]
            wrong += int((c.frames[i : i + _SOURCE_TICKS] != right).any(axis=1).sum())
    return Outcome(clip, times[DRAIN] - times[TRIGGERED], sum(c.lost_bytes for c in array.cameras.values()), wrong)


def _flush(folder: Path) -> None:
    """Have the disk hold what was written so far."""
    for path in folder.rglob("*.part"):
        file = os.open(path, os.O_RDONLY)
        os.fsync(file)
        os.close(file)


def array_profile(load: Load) -> RigProfile:
    """A rig without calibration."""
    cameras = tuple(
        camera_profile(f"cam_{i:02d}", f"SPEED{i:04d}", SECONDARY if i else PRIMARY) for i in range(load.cameras)
    )
    return RigProfile(
        name="speed",
        width=_WIDTH,
        height=_HEIGHT,
        layout=PLAIN,
        cameras=cameras,
        fps=load.fps,
        transfer_bytes=load.transfer_bytes,
        transfers=load.transfers,
        timeout_ms=2000,
    )


def _kept_per_s(outcome: Outcome) -> float:
    clip = outcome.clip
    lost = sum(c.stats.lost_ticks for c in clip.cameras)
    return (clip.n_ticks * len(clip.cameras) - lost) / outcome.seconds


def _row(into: str, load: Load, outcome: Outcome, queued: bool) -> list[str]:
    stats = [c.stats for c in outcome.clip.cameras]
    return [
        into,
        f"{load.transfers} queued" if queued else "one at a time",
        str(load.cameras),
        f"{load.cameras * load.fps * _FRAME / 1e6:.0f}",
        f"{_kept_per_s(outcome):.0f}",
        str(sum(s.lost_ticks for s in stats)),
        f"{outcome.unseen_bytes / 1e6:.1f}",
        "-" if into == "disk" else str(outcome.wrong_frames),
        f"{np.mean([s.idle_mean_ms for s in stats]):.3g}",
        f"{max(s.idle_worst_ms for s in stats):.3g}",
        "-" if into == "memory" else f"{100 * max(s.backlog / s.slots for s in stats):.0f}",
    ]
