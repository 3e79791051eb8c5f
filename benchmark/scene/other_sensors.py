"""Recordings of other sensors in a scene folder: frames of a conventional camera, events of an event camera.

conventional/CAMERA/TICK.png is the mean radiance over an exposure that begins at that tick, as 8-bit sRGB: gray [H, W],
or RGB [H, W, 3]. scene.json states the frame rate and the exposure time. A clip shorter than one exposure has no frame.

events/CAMERA.npz holds one entry per event in the arrays t (int64, microseconds from the start of the clip), x and y
(uint16, column and row, row 0 at the top) and p (uint8, 1: brighter, 0: darker), in order of time. scene.json states
the threshold of log radiance at which a pixel fires.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Int64, UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.scene.images import decode_srgb, read_png
from spike4dgs.benchmark.scene.manifest import Manifest
from spike4dgs.benchmark.untrusted import Expected, read_npz

T = TypeVar("T")
_DIGITS = 15  # of a tick
_MOST_EVENT_BYTES = 1 << 31  # of a camera: 165 million; at 400x250, an LED of 100 Hz gives up to 66 million in 100 ms


@dataclass(frozen=True, eq=False)
class Frame:
    """One exposure. Motion within it is blurred; what is brighter than white is clipped."""

    tick: int  # at which the exposure begins
    t_us: float  # the same in microseconds
    exposure_us: float
    srgb: UInt8  # [H, W] gray or [H, W, 3] RGB, sRGB-encoded

    @property
    def radiance(self) -> Float32:
        """Linear radiance [H, W] or [H, W, 3], 1.0 = white, to the precision of the 8-bit file."""
        return decode_srgb(self.srgb)


@dataclass(frozen=True, eq=False)
class Frames(Sequence[Frame]):
    """The frames of one camera, in order of time. A frame's file is checked and read when the frame is asked for.

    `[frame.t_us for frame in scene.frames("cam_00")]` is `[0.0, 16650.0, 33350.0]` at 20 kHz.
    """

    camera: str
    ticks: tuple[int, ...]  # at which the exposures begin
    shape: tuple[int, int]  # H, W
    rate_hz: float  # ticks per second of the scene's clock
    fps: float
    exposure_us: float
    files: Manifest  # of the scene, with this camera's frames alone

    @property
    def exposure_ticks(self) -> int:
        """Ticks that a frame is the mean of: its tick, and those that follow."""
        return round(self.exposure_us * 1e-6 * self.rate_hz)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.ticks)

    @overload
    def __getitem__(self, index: int) -> Frame: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[Frame]: ...

    def __getitem__(self, index: int | slice) -> Frame | Sequence[Frame]:
        """Return a frame, or those of a slice. Raises UserError where a file is missing or damaged."""
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        tick = self.ticks[index]
        image = read_png(self.files.path(f"conventional/{self.camera}/{tick:06d}.png"), self.shape)
        return Frame(tick, tick * 1e6 / self.rate_hz, self.exposure_us, image)


def find_frames(meta: Mapping[str, Any], files: Manifest, cameras: Sequence[str]) -> dict[str, Frames]:
    """Return the frames, unread, of those of `cameras` that have some. `meta`: scene.json."""
    found: dict[str, Frames] = {}
    for camera in cameras if meta.get("conventional") else ():
        own = files.only(f"conventional/{camera}/")
        if ticks := tuple(sorted(_tick(files, name) for name in own.files)):
            fps, exposure_s = (_fact(files, meta, "conventional", key) for key in ("fps", "exposure_s"))
            size = int(meta["height"]), int(meta["width"])
            found[camera] = Frames(camera, ticks, size, float(meta["rate_hz"]), fps, exposure_s * 1e6, own)
    return found


def _tick(files: Manifest, name: str) -> int:
    if not (stem := PurePosixPath(name).stem).isdecimal() or len(stem) > _DIGITS:
        raise problem(files.root / name[:200], "a frame named by its tick", "another name", "make the scene again")
    return int(stem)


def _fact(files: Manifest, meta: Mapping[str, Any], sensor: str, key: str) -> float:
    if key not in meta[sensor]:
        raise problem(files.root / "scene.json", f"{sensor}/{key}", "no such key", "make the scene again")
    return float(meta[sensor][key])


def frames_of(found: Mapping[str, Frames], camera: str, where: Path | str) -> Frames:
    """Return the frames of a camera. Raises UserError where there are none."""
    fix = "use a scene that has conventional/ and is longer than one exposure"
    return _of_camera(found, camera, "frames of a conventional camera", where, fix)


def events_of(found: Mapping[str, EventStream], camera: str, where: Path | str) -> EventStream:
    """Return the events of a camera. Raises UserError where there are none."""
    return _of_camera(found, camera, "events of an event camera", where, "use a scene that has events/")


def _of_camera(found: Mapping[str, T], camera: str, what: str, where: Path | str, fix: str) -> T:
    if camera not in found:
        names = f"those of {', '.join(found)}" if found else "none"
        raise problem(where, f"{what} at {camera}", names, fix)
    return found[camera]


_AGAIN = "restore it or make the scene again"


class Events(NamedTuple):
    """Events in order of time."""

    t: Int64  # microseconds from the start of the clip
    x: NDArray[np.uint16]  # column
    y: NDArray[np.uint16]  # row, 0 at the top
    p: UInt8  # 1: brighter, 0: darker


@dataclass(frozen=True, eq=False)
class EventStream:
    """The events of one camera. The file is checked and read when `events` is first used."""

    camera: str
    width: int
    height: int
    rate_hz: float  # ticks per second of the scene's clock
    n_ticks: int
    threshold: float  # change of log radiance for which a pixel fires
    files: Manifest  # of the scene, with this camera's file alone

    @cached_property
    def events(self) -> Events:
        """All events. Raises UserError where the file is damaged or holds events outside the clip or the image."""
        path = self.files.path(f"events/{self.camera}.npz")
        found = read_events(path)
        size = {"t": self.n_ticks * 1e6 / self.rate_hz, "x": self.width, "y": self.height, "p": 2}
        for name, column in found._asdict().items():
            outside = len(column) and not (column.min() >= 0 and column.max() < size[name])
            if column.shape != (len(found.t),) or outside:
                raise problem(path, f"{name} of every event in [0, {size[name]:g})", "other values", _AGAIN)
        if (found.t[1:] < found.t[:-1]).any():  # a difference of unsigned times would wrap
            raise problem(path, "events in order of time", "an earlier one after a later one", _AGAIN)
        return found

    def between(self, start_us: float, stop_us: float) -> Events:
        """Return the events at times start_us <= t < stop_us."""
        first, stop = np.searchsorted(self.events.t, [start_us, stop_us])
        return Events(*(column[first:stop] for column in self.events))  # type: ignore[arg-type]

    def __len__(self) -> int:
        """Return the number of events."""
        return len(self.events.t)


def find_events(meta: Mapping[str, Any], files: Manifest, cameras: Sequence[str]) -> dict[str, EventStream]:
    """Return the events, unread, of those of `cameras` that have some. `meta`: scene.json."""
    found: dict[str, EventStream] = {}
    for camera in cameras if meta.get("events") else ():
        if (name := f"events/{camera}.npz") in files.files:
            found[camera] = EventStream(
                camera,
                width=int(meta["width"]),
                height=int(meta["height"]),
                rate_hz=float(meta["rate_hz"]),
                n_ticks=int(meta["n_ticks"]),
                threshold=_fact(files, meta, "events", "threshold"),
                files=files.only(name),
            )
    return found


def write_events(path: Path, found: Events) -> None:
    """Write events as `.npz` with the arrays t, x, y, p. Equal events give equal bytes.

    Raises UserError where they are more than `read_events` takes.
    """
    if (total := sum(column.nbytes for column in found)) > _MOST_EVENT_BYTES:
        expected = f"events of {_MOST_EVENT_BYTES} bytes at most"
        raise problem(path, expected, f"{total}", "make a shorter clip, or calm the lamp")
    with atomic_path(path) as part:
        np.savez_compressed(part, allow_pickle=False, **found._asdict())


def read_events(path: Path) -> Events:
    """Read events. Raises UserError where the file is missing or damaged."""
    columns = dict.fromkeys(Events._fields, Expected("iu", (None,)))
    found = read_npz(path, "events (t, x, y, p)", columns, _AGAIN, most_bytes=_MOST_EVENT_BYTES)
    return Events(**found)
