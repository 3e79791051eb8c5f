"""The result of a capture: each camera's frames with their true ticks, its gaps, and statistics of its reads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.generators.recorder.frames.gaps import DISK, Gap, merged

FRAME_TAGS, ARRIVAL_TIMES = "frame tags", "arrival times"

# The sink of continuous mode: camera, true tick of the first frame, raw frames [n, frame_bytes] of consecutive ticks.
# The frames are a view of the ring: copy or write them before returning. Called from capture()'s thread only.
Sink = Callable[[str, int, UInt8], None]


@dataclass(frozen=True)
class CameraStats:
    """Statistics of one camera's capture."""

    bytes: int  # received after the trigger, dropped ones included
    blocks: int  # reads that ended with data
    short_reads: int
    backlog: int  # most ring slots that waited for the consumer at once
    slots: int  # of the ring
    lost_ticks: int  # within the clip
    idle_mean_ms: float  # time from one read's end to the next read's submission while none was in flight: mean, worst
    idle_worst_ms: float
    starved: int  # how often no read was in flight
    end: str  # "ok", or the reason that stopped this camera alone; "disk" where only its file ended


@dataclass(frozen=True, eq=False)
class CameraClip:
    """The frames of one camera. In continuous mode `frames` and `ticks` are empty: the sink has received them."""

    camera: str
    frames: UInt8  # [n, frame_bytes] raw, as received; a view of the ring where nothing is missing
    ticks: NDArray[np.int64]  # [n] true tick of each frame, ascending, within the clip
    gaps: tuple[Gap, ...]  # every tick of the clip that has no frame
    arrival: NDArray[np.int64]  # [m, 2]: ticks complete when a read ended, CLOCK_MONOTONIC ns
    stats: CameraStats


@dataclass(frozen=True, eq=False)
class Clip:
    """A capture of all cameras; ticks count from the first one after the trigger."""

    n_ticks: int
    cameras: tuple[CameraClip, ...]
    sync: str  # "frame tags", or "arrival times" where the layout has no tags or the cameras' counters are not common
    interrupted: bool  # stopped before the wanted length

    @property
    def complete(self) -> bool:
        """True if no camera lost a tick."""
        return not any(c.gaps for c in self.cameras)

    def without(self, gaps: tuple[Gap, ...]) -> Clip:
        """Return the same clip with these gaps, the ticks that the disk did not store."""
        cameras = []
        for c in self.cameras:
            if mine := [g for g in gaps if g.camera == c.camera]:
                every = merged([*c.gaps, *mine], self.n_ticks)
                end = DISK if c.stats.end == "ok" else c.stats.end
                stats = replace(c.stats, lost_ticks=sum(g.ticks for g in every), end=end)
                c = replace(c, gaps=every, stats=stats)
            cameras.append(c)
        return replace(self, cameras=tuple(cameras))
