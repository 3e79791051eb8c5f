"""The streams of a recording: files that grow as `.part` files at their true ticks during the capture.

Ticks that were never written are zeros, and listed as gaps.
"""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.arrays import Int64, UInt8
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import check_new, locked, writing
from spike4dgs.benchmark.scene.writer import stream_name
from spike4dgs.benchmark.spikes.bits import orient
from spike4dgs.benchmark.untrusted import check_ids
from spike4dgs.generators.recorder.clip_record import ClipRecord, write_description
from spike4dgs.generators.recorder.disk import Buffers, DiskFile
from spike4dgs.generators.recorder.frames.gaps import DISK, Gap, merged
from spike4dgs.generators.recorder.frames.layouts import make_layout
from spike4dgs.generators.recorder.rig_profile import TOP_DOWN, CameraProfile, RigProfile

_FRAMES = 256  # unpacked at a time: 3.2 MB of 400x250, which stays in the cache


class StreamFiles:
    """The streams of a recording in progress: one `.part` file for each camera, as long as the clip from the start.

    `write` is the sink of `capture`. Each camera's ticks ascend. A file that the system cannot write ends alone: its
    later ticks are dropped and become a gap of reason "disk". Only `finish` leaves files behind.

    For example::

        with StreamFiles(out, profile, n_ticks) as files:
            clip = capture(profile, links, seconds, sink=files.write)
            clip = clip.without(files.flush(clip.n_ticks))
            files.finish(ClipRecord(clip.n_ticks, gaps, sync))
    """

    def __init__(self, out: Path, profile: RigProfile, n_ticks: int) -> None:
        """Make the folder and reserve its disk space.

        Raises UserError where `out` is not new, where another process records into it, and where the disk is full.
        """
        self._out, self._profile, self._n_ticks = out, profile, n_ticks
        self._files: dict[str, DiskFile] = {}
        self._lost: tuple[Gap, ...] | None = None  # known after `flush`
        self._lock = ExitStack()
        with ExitStack() as lock:
            file = out.resolve().parent / f".{out.resolve().name}.lock"
            lock.enter_context(locked(file, out, "a folder that no other recording uses", temporary=True))
            _check_folder(out, profile)
            self._reserve()
            self._lock = lock.pop_all()

    def _reserve(self) -> None:
        """Make the files of the streams, and the memory between them and the cameras."""
        self._layout = make_layout(self._profile.layout, self._profile.width, self._profile.height)
        self._unpacked = np.empty((_FRAMES, self._layout.payload_bytes), np.uint8)
        size = self._n_ticks * self._layout.payload_bytes
        self.buffers = Buffers(len(self._profile.cameras), size)
        try:
            for camera in self._profile.cameras:
                with writing(self._path(camera)):
                    self._part(camera).parent.mkdir(parents=True, exist_ok=True)
                    self._files[camera.id] = DiskFile(self._part(camera), size, self.buffers)
        except BaseException:
            self._remove()
            raise

    @property
    def direct(self) -> bool:
        """True if all files have been written past the page cache so far."""
        return all(file.direct for file in self._files.values())

    @property
    def longest_write_s(self) -> float:
        """Return the longest time that the disk took for one buffer so far."""
        return max((file.longest_s for file in self._files.values()), default=0.0)

    @property
    def failures(self) -> dict[str, UserError]:
        """Camera -> why its file ended, as far as it is known yet."""
        errors = ((c, self._files[c.id].error) for c in self._profile.cameras if c.id in self._files)
        return {c.id: _refused(self._path(c), error) for c, error in errors if error is not None}

    @property
    def ended(self) -> bool:
        """True if no file accepts data any more, so that further recording is useless."""
        return all(file.error is not None for file in self._files.values())

    def write(self, camera: str, first_tick: int, frames: UInt8) -> None:
        """Unpack raw frames [n, frame_bytes] of consecutive ticks from `first_tick` on, and write them at their ticks.

        Frames after the end of the clip are left out. Waits while the disk is behind.
        """
        c, p = self._profile.camera(camera), self._profile
        for start in range(0, len(frames), _FRAMES):
            raw = frames[start : start + _FRAMES]
            packed = raw
            if not self._layout.packed:
                packed = self._unpacked[: len(raw)]
                self._layout.unpack(raw, packed)
            self.append(camera, first_tick + start, orient(packed, p.width, p.height, c.rows == TOP_DOWN, c.mirrored))

    def write_ticks(self, camera: str, ticks: Int64, frames: UInt8) -> None:
        """Write raw frames [n, frame_bytes] of ascending ticks [n]."""
        for part in np.split(np.arange(len(ticks)), np.nonzero(np.diff(ticks) != 1)[0] + 1):
            if len(part):
                self.write(camera, int(ticks[part[0]]), frames[part[0] : part[-1] + 1])

    def append(self, camera: str, first_tick: int, packed: UInt8) -> None:
        """Write packed ticks [n, payload_bytes], bottom-up and not mirrored, at their ticks."""
        inside = packed[: max(self._n_ticks - first_tick, 0)]
        if len(inside):
            self._files[camera].write(first_tick * self._layout.payload_bytes, inside.reshape(-1))

    def flush(self, n_ticks: int) -> tuple[Gap, ...]:
        """Cut the streams to the clip's length and wait for the disk. Return the ticks that it lost, of reason "disk".

        Raises UserError where it holds no tick of any stream.
        """
        if self._lost is None:
            for file in self._files.values():
                file.flush()
            size = n_ticks * self._layout.payload_bytes
            kept = {c: self._close(file, size) // self._layout.payload_bytes for c, file in self._files.items()}
            if self.failures and not any(kept.values()):
                raise next(iter(self.failures.values()))
            self._lost = merged((Gap(c, first, n_ticks - first, DISK) for c, first in kept.items()), n_ticks)
        return self._lost

    def finish(self, record: ClipRecord) -> Path:
        """Rename the streams and describe the folder, flushing first if necessary. Return the folder."""
        record = replace(record, gaps=merged([*record.gaps, *self.flush(record.n_ticks)], record.n_ticks))
        for camera in self._profile.cameras:
            with writing(self._path(camera)):
                os.replace(self._part(camera), self._path(camera))
            del self._files[camera.id]
        write_description(self._out, self._profile, record)
        return self._out

    def __enter__(self) -> StreamFiles:
        return self

    def __exit__(self, *_: object) -> None:
        self._remove()

    def _close(self, file: DiskFile, size: int) -> int:
        """Close a stream of `size` bytes. Return how many bytes the disk then holds; a torn tick is zero."""
        kept = size
        if file.error is not None:
            kept = min(file.written // self._layout.payload_bytes * self._layout.payload_bytes, size)
            file.blank(kept)
        try:
            file.close(size)
        except OSError as e:
            file.error, kept = e, 0  # its contents are unknown
        return kept

    def _path(self, camera: CameraProfile) -> Path:
        return self._out / (stream_name(camera.id) if self._profile.calibrated else f"{camera.id}.dat")

    def _part(self, camera: CameraProfile) -> Path:
        path = self._path(camera)
        return path.with_name(f".{path.name}.part")

    def _remove(self) -> None:
        """Remove unfinished files, and the folders that are then empty. Release the lock."""
        for camera in self._profile.cameras:
            if camera.id in self._files:
                self._files.pop(camera.id).close()
                self._part(camera).unlink(missing_ok=True)
        for folder in (self._out / "spikes", self._out):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
        self._lock.close()


def _check_folder(out: Path, profile: RigProfile) -> None:
    if (part := next((p for part in ("", "spikes/") for p in out.glob(f"{part}.*.dat.part")), None)) is not None:
        found = "the streams of a recording that is running or was killed"
        raise problem(part, "a folder without a recording", found, f"choose another --out, or remove {out}")
    check_new(out)
    if profile.calibrated:
        check_ids([out.resolve().name], "scene", out, "choose another --out")


def _refused(path: Path, error: OSError) -> UserError:
    try:
        with writing(path):
            raise error
    except UserError as e:
        return e
    except OSError as e:
        fix = "read the kernel's log (dmesg) for its errors, and choose another disk"
        return problem(path, "a disk that writes", (e.strerror or str(e)).lower(), fix)
