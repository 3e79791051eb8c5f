"""One measurement of `speed record`: paced emulated cameras of 400x250, captured into memory or to disk."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.generators.recorder.capture import DRAIN, TRIGGERED, capture
from spike4dgs.generators.recorder.checks import find_cameras
from spike4dgs.generators.recorder.clip_files import StreamFiles
from spike4dgs.generators.recorder.disk import BUFFER_BYTES, Buffers, DiskFile
from spike4dgs.generators.recorder.emulation.array import EmulatedArray, camera_profile
from spike4dgs.generators.recorder.emulation.camera import EmulatedCamera
from spike4dgs.generators.recorder.emulation.ports import emulated_ports
from spike4dgs.generators.recorder.frames.clip import Clip
from spike4dgs.generators.recorder.frames.layouts import PLAIN
from spike4dgs.generators.recorder.resources import buffer_seconds, real_time
from spike4dgs.generators.recorder.rig_profile import PRIMARY, SECONDARY, RigProfile
from spike4dgs.generators.recorder.sync import Rate
from spike4dgs.generators.recorder.usb.link import Link
from spike4dgs.generators.recorder.usb.reads import Completion, Transfers

FRAME_BYTES = 12500
_WIDTH, _HEIGHT = 400, 250
_SOURCE_TICKS = 64  # that each camera sends in a loop
_CHECKED = 500  # ticks of each file that are read again


@dataclass(frozen=True)
class Load:
    """The load of a measurement: cameras of 400x250 at `fps`, and how they are read."""

    cameras: int
    fps: int
    transfer_bytes: int
    transfers: int
    memory_bytes: int  # of a camera itself, for the time without a read
    buffer_s: float | None = None  # of data that may wait for the disk; None: as `record` chooses it

    @property
    def bytes_per_s(self) -> float:
        """Bytes a second that all cameras send."""
        return float(self.cameras * self.fps * FRAME_BYTES)


@dataclass(frozen=True, eq=False)
class Outcome:
    """A capture of emulated cameras, and the losses known to the cameras."""

    clip: Clip
    seconds: float  # from the trigger to the last byte, and on the disk where it goes there
    unseen_bytes: int  # lost by cameras because no read was in flight; unnoticed without tags
    wrong_frames: int  # in the clip in memory, or at some ticks of each file, that differ from the camera's
    flush_s: float  # of `seconds`, to write the rest at the end and to fsync
    backlog: NDArray[np.float64]  # [n, 2]: seconds since the trigger, bytes then waiting in rings and buffers
    buffer_s: float  # of data that could wait in rings
    longest_write_s: float  # of one buffer
    waited_s: float  # of `seconds`, in which the delivery waited for the disk
    cpu: float  # cores that were busy with this process
    emulator_cpu: float  # of these, for work that a USB controller does for real cameras
    direct: bool  # past the page cache
    urgent: bool  # at real-time priority

    @property
    def fullest_s(self) -> float:
        """The most data that waited in the ring of one camera at once, in seconds."""
        return max((c.stats.backlog / c.stats.slots * self.buffer_s for c in self.clip.cameras), default=0.0)

    @property
    def lost_ticks(self) -> int:
        """Ticks in gaps, of all cameras."""
        return sum(c.stats.lost_ticks for c in self.clip.cameras)

    @property
    def frames_per_s(self) -> float:
        """Frames of all cameras that were kept, a second."""
        return (self.clip.n_ticks * len(self.clip.cameras) - self.lost_ticks) / self.seconds


class _SentReads:
    """Reads on an emulated camera, stamped with the time when the camera had sent them, not when they were checked."""

    def __init__(self, inner: Transfers, link: _Link) -> None:
        self.depth = inner.depth
        self._inner, self._link = inner, link
        self._submitted_ns: deque[int] = deque()

    @property
    def in_flight(self) -> int:
        """Number of reads that have not ended, from the queue."""
        return self._inner.in_flight

    def submit(self, buffer: UInt8) -> None:
        """Queue a read."""
        self._submitted_ns.append(time.monotonic_ns())
        self._inner.submit(buffer)

    def wait(self, timeout_s: float) -> Completion | None:
        """Return the oldest read's end."""
        due_s = self._link.emulated.due_s(self._link.profile.transfer_bytes)  # infinite before the start
        begun_s = time.thread_time()
        done = self._inner.wait(timeout_s)
        self._link.cpu_s += time.thread_time() - begun_s
        if done is None:
            return None
        sent_ns = max(due_s * 1e9, self._submitted_ns.popleft())
        return Completion(done.bytes, int(min(sent_ns, done.arrival_ns)), done.status)

    def cancel(self) -> list[Completion]:
        """End every read."""
        return self._inner.cancel()


@dataclass(eq=False)
class _Link(Link):
    """A link whose reads have true times, and which measures the cost of emulating its camera."""

    emulated: EmulatedCamera
    cpu_s: float = 0.0

    def transfers(self) -> Transfers:
        """Return reads with true times."""
        return _SentReads(super().transfers(), self)


@dataclass(eq=False)
class _Watch:
    """Records the rates of a capture; times count from the trigger."""

    load: Load
    links: Mapping[str, _Link]
    files: StreamFiles | None = None
    urgent: bool = False
    seconds: float = 0.0  # until DRAIN
    cpu_s: float = 0.0  # of this process
    emulator_s: float = 0.0  # CPU time of the emulation
    backlog: list[tuple[float, int]] = field(default_factory=list)

    def state(self, state: str) -> None:
        """Run the clocks from TRIGGERED to DRAIN."""
        if state in (TRIGGERED, DRAIN):
            sign = -1 if state == TRIGGERED else 1
            self.seconds += sign * time.monotonic()
            self.cpu_s += sign * time.process_time()
            self.emulator_s += sign * sum(link.cpu_s for link in self.links.values())

    def rates(self, rates: Mapping[str, Rate]) -> None:
        """Record the bytes that wait now."""
        waiting = sum(r.backlog for r in rates.values()) * self.load.transfer_bytes
        waiting += self.files.buffers.waiting if self.files is not None else 0
        self.backlog.append((time.monotonic() + self.seconds, waiting))


def run(load: Load, seconds: float, folder: Path | None = None) -> Outcome:
    """Capture `seconds` of paced cameras into memory, or in continuous mode to files in `folder`, which are removed."""
    profile = array_profile(load)
    profile = replace(profile, ring_seconds=buffer_seconds(profile, seconds))
    rng = np.random.default_rng(0)
    sources = {c.id: rng.integers(0, 256, (_SOURCE_TICKS, FRAME_BYTES), dtype=np.uint8) for c in profile.cameras}
    array = EmulatedArray(profile, sources, memory_bytes=load.memory_bytes)
    ports = find_cameras(profile, emulated_ports(array))
    links = {c.id: _Link(ports[c.id], c, profile, array.cameras[c.id]) for c in profile.cameras}
    watch = _Watch(load, links)
    if folder is None:
        with real_time() as watch.urgent:
            clip = capture(profile, links, seconds, on_state=watch.state)
        return _outcome(watch, array, clip, _wrong(clip, sources))
    with StreamFiles(folder, profile, round(seconds * load.fps)) as watch.files:
        with real_time() as watch.urgent:
            clip = capture(profile, links, seconds, on_state=watch.state, on_rate=watch.rates, sink=watch.files.write)
        flushing = time.monotonic()
        clip = clip.without(watch.files.flush(clip.n_ticks))
        flush_s = time.monotonic() - flushing
        return _outcome(watch, array, clip, _wrong_on_disk(folder, clip, sources), flush_s)


def disk_rate(folder: Path, files: int, seconds: float, bytes_per_s: float) -> float:
    """Return bytes a second to disk, fsync included, for as many files and bytes as a recording, without any camera."""
    data = np.random.default_rng(0).integers(0, 256, BUFFER_BYTES, dtype=np.uint8)
    n = max(round(seconds * bytes_per_s / files / len(data)), 1)
    buffers = Buffers(files, n * len(data))
    opened = [DiskFile(folder / f"{i}.raw", n * len(data), buffers) for i in range(files)]
    begun = time.monotonic()
    for k in range(n):
        for file in opened:
            file.write(k * len(data), data)
    for file in opened:
        file.close(n * len(data))
    taken = time.monotonic() - begun
    for i in range(files):
        (folder / f"{i}.raw").unlink()
    if error := next((file.error for file in opened if file.error is not None), None):
        raise error
    return files * n * len(data) / taken


def array_profile(load: Load) -> RigProfile:
    """Return a rig without calibration."""
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
        ring_seconds=load.buffer_s,
        timeout_ms=2000,
    )


def _outcome(watch: _Watch, array: EmulatedArray, clip: Clip, wrong: int, flush_s: float = 0.0) -> Outcome:
    files = watch.files
    return Outcome(
        clip=clip,
        seconds=watch.seconds + flush_s,
        unseen_bytes=sum(c.lost_bytes for c in array.cameras.values()),
        wrong_frames=wrong,
        flush_s=flush_s,
        backlog=np.array(watch.backlog, np.float64).reshape(-1, 2),
        buffer_s=array.profile.ring_seconds or 0.0,
        longest_write_s=files.longest_write_s if files else 0.0,
        waited_s=files.buffers.waited_s if files else 0.0,
        cpu=watch.cpu_s / watch.seconds,
        emulator_cpu=watch.emulator_s / watch.seconds,
        direct=files is not None and files.direct,
        urgent=watch.urgent,
    )


def _wrong(clip: Clip, sources: Mapping[str, UInt8]) -> int:
    """Return the number of frames in memory that differ from what the camera sent at their tick."""
    wrong = 0
    for c in clip.cameras:
        for i in range(0, len(c.ticks), _SOURCE_TICKS):
            right = sources[c.camera][c.ticks[i : i + _SOURCE_TICKS] % _SOURCE_TICKS]
            wrong += int((c.frames[i : i + _SOURCE_TICKS] != right).any(axis=1).sum())
    return wrong


def _wrong_on_disk(folder: Path, clip: Clip, sources: Mapping[str, UInt8]) -> int:
    """Return the same number for some frames in each file; frames in gaps must be zeros."""
    wrong = 0
    for c in clip.cameras:
        kept = present(c.gaps, clip.n_ticks)
        with open(folder / f".{c.camera}.dat.part", "rb") as f:
            for tick in np.unique(np.linspace(0, clip.n_ticks - 1, _CHECKED).astype(np.int64)):
                right = sources[c.camera][tick % _SOURCE_TICKS] * np.uint8(kept[tick])
                wrong += os.pread(f.fileno(), FRAME_BYTES, int(tick) * FRAME_BYTES) != right.tobytes()
    return wrong
