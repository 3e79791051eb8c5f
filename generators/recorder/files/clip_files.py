"""A recording on disk: streams that grow as `.part` files at their true ticks, then the folder around them.

With a calibrated rig the folder is a scene, `spike4dgs-scene/1`; without poses it is a folder of streams with its
`stream.json`, which `inspect` and `calibrate-rig` read. Ticks that were never written are zeros, and listed as gaps.
Description and manifest are written last, so that a folder without them is an unfinished recording.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from spike4dgs.benchmark.environment import command_line, environment, harness, utc_now
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import atomic_path, check_new, writing
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import Target
from spike4dgs.benchmark.scene.splits import Split, standard_splits
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene, stream_name
from spike4dgs.benchmark.spikes.folder import write_stream_folder
from spike4dgs.benchmark.spikes.stream import open_stream
from spike4dgs.generators.recorder.files.disk import Buffers, DiskFile
from spike4dgs.generators.recorder.frames.gaps import DISK, Gap, merged
from spike4dgs.generators.recorder.frames.layouts import Int64, UInt8, make_layout, orient
from spike4dgs.generators.recorder.profile.profile import NAME, TOP_DOWN, CameraProfile, RigProfile

_FRAMES = 256  # unpacked at a time: 3.2 MB of 400x250, which stays in the cache


@dataclass(frozen=True, eq=False)
class ClipRecord:
    """What a recording states beside its streams.

    `cameras` are figures of each camera's capture, by id, for scene.json. `targets`, `extras` and `files` (path in the
    folder -> file to copy) are for recordings whose ground truth is known, such as emulated ones; a rig without poses
    does not write them.
    """

    n_ticks: int
    gaps: tuple[Gap, ...]
    sync: Mapping[str, Any]  # "method" at least
    t0_ns: int = 0  # of tick 0, on the clock that `clock` names
    clock: str = "unknown"
    cameras: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    targets: tuple[Target, ...] = ()
    extras: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    files: Mapping[str, Path] = field(default_factory=dict)


class StreamFiles:
    """The streams of a recording in progress: one `.part` file for each camera, as long as the clip from the start.

    `write` is what `capture` calls its sink. Each camera's ticks ascend. A file that the system does not write ends
    alone: what follows is dropped, and a gap of reason "disk". Only `finish` leaves anything behind.

    >>> with StreamFiles(out, profile, n_ticks) as files:  # doctest: +SKIP
    ...     clip = capture(profile, links, seconds, sink=files.write)
    ...     clip = clip.without(files.flush(clip.n_ticks))
    ...     files.finish(ClipRecord(clip.n_ticks, gaps, sync))
    """

    def __init__(self, out: Path, profile: RigProfile, n_ticks: int) -> None:
        """Make the folder and reserve its disk space. Raises UserError where `out` is not new, or has no room."""
        _check_place(out, profile)
        self._out, self._profile, self._n_ticks = out, profile, n_ticks
        self._layout = make_layout(profile.layout, profile.width, profile.height)
        self._unpacked = np.empty((_FRAMES, self._layout.payload_bytes), np.uint8)
        self._files: dict[str, DiskFile] = {}
        self._lost: tuple[Gap, ...] | None = None  # known after `flush`
        size = n_ticks * self._layout.payload_bytes
        self.buffers = Buffers(len(profile.cameras), size)
        try:
            for camera in profile.cameras:
                with writing(self._path(camera)):
                    self._part(camera).parent.mkdir(parents=True, exist_ok=True)
                    self._files[camera.id] = DiskFile(self._part(camera), size, self.buffers)
        except BaseException:
            self._remove()
            raise

    @property
    def direct(self) -> bool:
        """Whether all files have been written past the page cache so far."""
        return all(file.direct for file in self._files.values())

    @property
    def failures(self) -> dict[str, UserError]:
        """Camera -> why its file ended, as far as it is known yet."""
        errors = ((c, self._files[c.id].error) for c in self._profile.cameras if c.id in self._files)
        return {c.id: _refused(self._path(c), error) for c, error in errors if error is not None}

    @property
    def ended(self) -> bool:
        """Whether no file takes anything any more, so that there is nothing to record for."""
        return all(file.error is not None for file in self._files.values())

    def write(self, camera: str, first_tick: int, frames: UInt8) -> None:
        """Unpack raw frames [n, frame_bytes] of consecutive ticks from `first_tick` on, and write them in their place.

        Frames from the end of the clip on are left out. Waits where the disk is behind.
        """
        c, p = self._profile.camera(camera), self._profile
        for start in range(0, len(frames), _FRAMES):
            raw = frames[start : start + _FRAMES]
            packed = raw
            if self._layout.has_tags():
                packed = self._unpacked[: len(raw)]
                self._layout.unpack(raw, packed)
            self.append(camera, first_tick + start, orient(packed, p.width, p.height, c.rows == TOP_DOWN, c.mirrored))

    def write_ticks(self, camera: str, ticks: Int64, frames: UInt8) -> None:
        """Write raw frames [n, frame_bytes] of ascending ticks [n]."""
        for part in np.split(np.arange(len(ticks)), np.nonzero(np.diff(ticks) != 1)[0] + 1):
            if len(part):
                self.write(camera, int(ticks[part[0]]), frames[part[0] : part[-1] + 1])

    def append(self, camera: str, first_tick: int, packed: UInt8) -> None:
        """Write packed ticks [n, payload_bytes], bottom-up and not mirrored, in their place."""
        inside = packed[: max(self._n_ticks - first_tick, 0)]
        if len(inside):
            self._files[camera].write(first_tick * self._layout.payload_bytes, inside.reshape(-1))

    def flush(self, n_ticks: int) -> tuple[Gap, ...]:
        """Cut the streams to the clip's length and have the disk hold them; what it does not hold, reason "disk".

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
        """Rename the streams and describe the folder, which is returned. Flushes them where that has not been done."""
        record = replace(record, gaps=merged([*record.gaps, *self.flush(record.n_ticks)], record.n_ticks))
        for camera in self._profile.cameras:
            with writing(self._path(camera)):
                os.replace(self._part(camera), self._path(camera))
            del self._files[camera.id]
        if self._profile.calibrated:
            _finish_scene(self._out, self._profile, record)
        else:
            _finish_streams(self._out, self._profile, record)
        return self._out

    def __enter__(self) -> StreamFiles:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._remove()

    def _close(self, file: DiskFile, size: int) -> int:
        """How many bytes of a stream of `size` the disk then holds; a tick that was torn is zero."""
        kept = size
        if file.error is not None:
            kept = min(file.written // self._layout.payload_bytes * self._layout.payload_bytes, size)
            file.blank(kept)
        try:
            file.close(size)
        except OSError as e:
            file.error, kept = e, 0  # nobody knows what of it is there
        return kept

    def _path(self, camera: CameraProfile) -> Path:
        return self._out / (stream_name(camera.id) if self._profile.calibrated else f"{camera.id}.dat")

    def _part(self, camera: CameraProfile) -> Path:
        path = self._path(camera)
        return path.with_name(f".{path.name}.part")

    def _remove(self) -> None:
        """Drop what was not finished, and the folders that hold nothing."""
        for camera in self._profile.cameras:
            if camera.id in self._files:
                self._files.pop(camera.id).close()
                self._part(camera).unlink(missing_ok=True)
        for folder in (self._out / "spikes", self._out):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()


def write_clip(out: Path, profile: RigProfile, streams: Mapping[str, UInt8], record: ClipRecord) -> Path:
    """Write a recording whose packed streams [n_ticks, payload_bytes], bottom-up and not mirrored, are in memory.

    Ticks within gaps are written as zeros, whatever the streams hold. Raises UserError where `out` is not new or cannot
    be written.
    """
    with StreamFiles(out, profile, record.n_ticks) as files:
        for camera in profile.cameras:
            at = 0
            for gap in (*_gaps_of(camera.id, record.gaps), Gap(camera.id, record.n_ticks, 0, "")):
                files.append(camera.id, at, streams[camera.id][at : gap.first_tick])
                at = gap.stop_tick
        return files.finish(record)


def _check_place(out: Path, profile: RigProfile) -> None:
    if (part := next((p for part in ("", "spikes/") for p in out.glob(f"{part}.*.dat.part")), None)) is not None:
        found = "the streams of one that still runs, or was killed"
        raise problem(part, "a folder without a recording", found, f"choose another --out, or remove {out}")
    check_new(out)
    if profile.calibrated and not NAME.match(out.resolve().name):
        fix = "choose another --out"
        raise problem(out, "a scene's name: letters, digits, '.', '_' and '-'", repr(out.resolve().name), fix)


def _refused(path: Path, error: OSError) -> UserError:
    try:
        with writing(path):
            raise error
    except UserError as e:
        return e
    except OSError as e:
        fix = "see what the kernel's log (dmesg) says of it, and choose another disk"
        return problem(path, "a disk that writes", (e.strerror or str(e)).lower(), fix)


def _gaps_of(camera: str, gaps: Iterable[Gap]) -> tuple[Gap, ...]:
    return tuple(sorted(g for g in gaps if g.camera == camera))


def _source(profile: RigProfile, record: ClipRecord) -> dict[str, Any]:
    """Who recorded, with what, and how it went: `source` of the description."""
    lost = {c.id: sum(g.ticks for g in _gaps_of(c.id, record.gaps)) for c in profile.cameras}
    cameras = {
        c.id: {"serial": c.serial, "role": c.role, "lost_ticks": lost[c.id], **record.cameras.get(c.id, {})}
        for c in profile.cameras
    }
    return {
        "kind": "recorder",
        "rig": profile.name,
        "layout": profile.layout,
        "recorded": utc_now(),
        "command": command_line(),
        "harness": harness(),
        "environment": {**environment("cpu"), "pyusb": version("pyusb")},
        "cameras": cameras,
    }


def _finish_streams(out: Path, profile: RigProfile, record: ClipRecord) -> None:
    size, gaps = (profile.width, profile.height), merged(record.gaps, record.n_ticks)
    streams = {
        c.id: open_stream(out / f"{c.id}.dat", *size, float(profile.fps), gaps=_gaps_of(c.id, gaps))
        for c in profile.cameras
    }
    facts = {"clock": _clock(record), "sync": _sync(record), "source": _source(profile, record)}
    write_stream_folder(out, streams, facts)


def _finish_scene(out: Path, profile: RigProfile, record: ClipRecord) -> None:
    cameras = tuple(c.calibration for c in profile.cameras if c.calibration is not None)
    for c in profile.cameras:
        if c.maps:
            _copy(c.maps, out / f"calibration/maps/{c.id}.npz")
    for name, path in record.files.items():
        _copy(path, out / name)
    name = out.resolve().name
    finish_scene(
        out,
        SceneDescription(
            id=name,
            title=profile.title or f"Recording {name}",
            licence=profile.licence,
            cameras=cameras,
            train=tuple(c.id for c in cameras if c.id not in profile.held_out),
            test=profile.held_out,
            splits=_splits(cameras, profile.held_out),
            rate_hz=float(profile.fps),
            n_ticks=record.n_ticks,
            radiance_gain=profile.radiance_gain,
            targets=record.targets,
            sensor={"model": profile.sensor, "rows_bottom_up": True},
            source=_source(profile, record),
            clock=_clock(record),
            sync=_sync(record),
            gaps=tuple(g.record for g in merged(record.gaps, record.n_ticks)),
            extras=record.extras,
        ),
    )


def _splits(cameras: tuple[Camera, ...], held_out: tuple[str, ...]) -> dict[str, Split]:
    return standard_splits(cameras, held_out[0]) if len(held_out) == 1 else {}


def _clock(record: ClipRecord) -> dict[str, Any]:
    return {"t0_ns": record.t0_ns, "source": record.clock}


def _sync(record: ClipRecord) -> dict[str, Any]:
    return {"max_error_us": record.sync.get("worst_pair_us"), **record.sync}


def _copy(source: Path, target: Path) -> None:
    with atomic_path(target) as part:
        shutil.copyfile(source, part)
