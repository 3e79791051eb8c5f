"""Events of an event camera: the file of one camera, and its reader.

events/CAMERA.npz holds one entry per event in the arrays t (int64, microseconds from the start of the clip), x and y
(uint16, column and row, row 0 at the top) and p (uint8, 1: brighter, 0: darker), in order of time. scene.json states
the threshold of log radiance at which a pixel fires.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.scene.manifest import Manifest
from spike4dgs.benchmark.untrusted.npz import Expected, read_npz

_AGAIN = "restore it or make the scene again"


class Events(NamedTuple):
    """Events in order of time."""

    t: NDArray[np.int64]  # microseconds from the start of the clip
    x: NDArray[np.uint16]  # column
    y: NDArray[np.uint16]  # row, 0 at the top
    p: NDArray[np.uint8]  # 1: brighter, 0: darker


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
        self._check(found, path)
        return found

    @property
    def ticks(self) -> NDArray[np.int64]:
        """The tick that contains each event."""
        return (self.events.t * (self.rate_hz * 1e-6)).astype(np.int64)

    def between(self, start_us: float, stop_us: float) -> Events:
        """Return the events at times start_us <= t < stop_us."""
        first, stop = np.searchsorted(self.events.t, [start_us, stop_us])
        return Events(*(column[first:stop] for column in self.events))  # type: ignore[arg-type]

    def __len__(self) -> int:
        """Return the number of events."""
        return len(self.events.t)

    def _check(self, found: Events, path: Path) -> None:
        for name, column, stop in (
            ("t", found.t, self.n_ticks * 1e6 / self.rate_hz),
            ("x", found.x, self.width),
            ("y", found.y, self.height),
            ("p", found.p, 2),
        ):
            if column.shape != (len(found.t),) or len(column) and not (column.min() >= 0 and column.max() < stop):
                raise problem(path, f"{name} of every event in [0, {stop:g})", "other values", _AGAIN)
        if (np.diff(found.t) < 0).any():
            raise problem(path, "events in order of time", "an earlier one after a later one", _AGAIN)


def find_events(meta: Mapping[str, Any], files: Manifest, cameras: Sequence[str]) -> dict[str, EventStream]:
    """Return the events, unread, of those of `cameras` that have some. `meta`: scene.json."""
    found: dict[str, EventStream] = {}
    facts: Mapping[str, Any] = meta.get("events", {})
    for camera in cameras if facts else ():
        if (name := f"events/{camera}.npz") in files.files:
            if "threshold" not in facts:
                raise problem(files.root / "scene.json", "events/threshold", "no such key", "make the scene again")
            size, clock = (int(meta["width"]), int(meta["height"])), (float(meta["rate_hz"]), int(meta["n_ticks"]))
            found[camera] = EventStream(camera, *size, *clock, float(facts["threshold"]), files.only(name))
    return found


def events_of(found: Mapping[str, EventStream], camera: str, where: Path | str) -> EventStream:
    """Return the events of a camera. Raises UserError where there are none."""
    if camera not in found:
        names = f"those of {', '.join(found)}" if found else "none"
        raise problem(where, f"events of an event camera at {camera}", names, "use a scene that has events/")
    return found[camera]


def write_events(path: Path, found: Events) -> None:
    """Write events as `.npz` with the arrays t, x, y, p. Equal events give equal bytes."""
    with atomic_path(path) as part:
        np.savez_compressed(part, allow_pickle=False, **found._asdict())


def read_events(path: Path) -> Events:
    """Read events. Raises UserError where the file is missing or damaged."""
    found = read_npz(path, "events (t, x, y, p)", dict.fromkeys(Events._fields, Expected("iu", (None,))), _AGAIN)
    return Events(**found)
