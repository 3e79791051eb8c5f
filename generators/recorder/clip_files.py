"""A recording on disk: streams that grow as `.part` files at their true ticks, then the folder around them.

With a calibrated rig the folder is a scene, `spike4dgs-scene/1`; without poses it is a folder of streams with its
`stream.json`, which `inspect` and `calibrate-rig` read. Ticks that were never written are zeros, and listed as gaps.
Description and manifest are written last, so that a folder without them is an unfinished recording.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from spike4dgs.benchmark.cameras import Camera
from spike4dgs.benchmark.environment import command_line, environment, harness, utc_now
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path, check_new, writing
from spike4dgs.benchmark.scene import Target
from spike4dgs.benchmark.scene_writer import SceneDescription, finish_scene, stream_name
from spike4dgs.benchmark.spikes import open_stream
from spike4dgs.benchmark.splits import Split, standard_splits
from spike4dgs.benchmark.stream_folder import write_stream_folder
from spike4dgs.generators.recorder.gaps import Gap, merged
from spike4dgs.generators.recorder.layouts import Int64, UInt8, make_layout, orient
from spike4dgs.generators.recorder.profile import NAME, TOP_DOWN, CameraProfile, RigProfile

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

    `write` is what `capture` calls its sink. Only `finish` leaves anything behind.

    >>> with StreamFiles(out, profile, n_ticks) as files:  # doctest: +SKIP
    ...     clip = capture(profile, links, seconds, sink=files.write)
    ...     files.finish(ClipRecord(clip.n_ticks, gaps, sync))
    """

    def __init__(self, out: Path, profile: RigProfile, n_ticks: int) -> None:
        """Make the folder and reserve its disk space. Raises UserError where `out` is not new, or has no room."""
        check_new(out)
        if profile.calibrated and not NAME.match(out.resolve().name):
            fix = "choose another --out"
            raise problem(out, "a scene's name: letters, digits, '.', '_' and '-'", repr(out.resolve().name), fix)
        self._out, self._profile, self._n_ticks = out, profile, n_ticks
        self._layout = make_layout(profile.layout, profile.width, profile.height)
        self._unpacked = np.empty((_FRAMES, self._layout.payload_bytes), np.uint8)
        self._files: dict[str, int] = {}
        try:
            for camera in profile.cameras:
                with writing(self._path(camera)):
                    self._part(camera).parent.mkdir(parents=True, exist_ok=True)
                    self._files[camera.id] = os.open(self._part(camera), os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o644)
                    os.posix_fallocate(self._files[camera.id], 0, n_ticks * self._layout.payload_bytes)
        except BaseException:
            self._remove()
            raise

    def write(self, camera: str, first_tick: int, frames: UInt8) -> None:
        """Unpack raw frames [n, frame_bytes] of consecutive ticks from `first_tick` on, and write them in their place.

        Frames from the end of the clip on are left out. Raises UserError where the system cannot write.
        """
        c, p = self._profile.camera(camera), self._profile
        for start in range(0, len(frames), _FRAMES):
            raw = frames[start : start + _FRAMES]
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
        size = self._layout.payload_bytes
        left = packed[: max(self._n_ticks - first_tick, 0)].reshape(-1).data
        at = first_tick * size
        with writing(self._path(self._profile.camera(camera))):
            while left:
                done = os.pwrite(self._files[camera], left, at)
                left, at = left[done:], at + done

    def finish(self, record: ClipRecord) -> Path:
        """Cut the streams to the clip's length, fsync and rename them, and describe the folder, which is returned."""
        for camera in self._profile.cameras:
            with writing(self._path(camera)):
                os.truncate(self._files[camera.id], record.n_ticks * self._layout.payload_bytes)
                os.fsync(self._files[camera.id])
                os.close(self._files.pop(camera.id))
                os.replace(self._part(camera), self._path(camera))
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

    def _path(self, camera: CameraProfile) -> Path:
        return self._out / (stream_name(camera.id) if self._profile.calibrated else f"{camera.id}.dat")

    def _part(self, camera: CameraProfile) -> Path:
        path = self._path(camera)
        return path.with_name(f".{path.name}.part")

    def _remove(self) -> None:
        """Drop what was not finished, and the folders that hold nothing."""
        for camera in self._profile.cameras:
            if camera.id in self._files:
                os.close(self._files.pop(camera.id))
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
