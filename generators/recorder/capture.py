"""Capture: one thread for each camera, reads in flight from before the trigger to the last tick, losses on record.

States: OPEN (devices opened), ARMED (every camera has proven a block), TRIGGERED (recording), DRAIN (the wanted ticks
are in; what is still on its way is read and dropped), CLOSED.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spike4dgs.generators.recorder.gaps import Gap
from spike4dgs.generators.recorder.profile import RigProfile
from spike4dgs.generators.recorder.transport import Link

UInt8 = NDArray[np.uint8]

STATES = ("OPEN", "ARMED", "TRIGGERED", "DRAIN", "CLOSED")

# What continuous mode writes with: camera, true tick of the first frame, raw frames [n, frame_bytes] of consecutive
# ticks. The frames are a view of the ring: copy or write them before returning. Called from capture()'s thread only.
Sink = Callable[[str, int, UInt8], None]


@dataclass(frozen=True)
class CameraStats:
    """How one camera's capture went."""

    bytes: int  # received after the trigger, dropped ones included
    blocks: int  # reads that ended with data
    short_reads: int
    backlog: int  # most ring slots that waited for the consumer at once
    slots: int  # of the ring
    lost_ticks: int  # within the clip
    idle_mean_ms: float  # time from one read's end to the next read's submission while none was in flight: mean, worst
    idle_worst_ms: float
    starved: int  # how often no read was in flight
    queued: bool
    end: str  # "ok", or the reason that stopped this camera alone


@dataclass(frozen=True)
class Rate:
    """What `on_rate` is told about one camera, a few times a second."""

    bytes_per_s: float
    ticks: int  # received since the trigger
    spikes_per_tick: float  # mean over the pixels of the newest frames, 0..1
    backlog: int  # ring slots that wait
    lost_ticks: int


@dataclass(frozen=True, eq=False)
class CameraClip:
    """What one camera delivered. In continuous mode `frames` and `ticks` are empty: the sink has had them."""

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
    sync: str  # "frame tags", or "arrival times" where the layout has none or the cameras' counters are not common
    interrupted: bool  # stopped before the wanted length

    @property
    def complete(self) -> bool:
        """Whether no camera lost anything."""
        return not any(c.gaps for c in self.cameras)


def capture(
    profile: RigProfile,
    links: Mapping[str, Link],
    seconds: float,
    *,
    on_state: Callable[[str], None] | None = None,
    on_rate: Callable[[Mapping[str, Rate]], None] | None = None,
    stop: threading.Event | None = None,
    sink: Sink | None = None,
) -> Clip:
    """Record `seconds` of every camera of `links` (camera id -> opened link); the links are closed in any case.

    Each camera is rehearsed first: started, it must deliver one block, and is stopped again. Then secondaries are
    started before the primary, and every camera's first byte begins its first frame. A camera without a stop
    sequence cannot start anew: its tick 0 is the first complete frame after TRIGGERED.

    Without `sink` everything stays in memory and `frames` are views of it. With it (continuous mode) whole frames are
    handed on while the capture runs, and a sink that is too slow costs ticks, which are recorded as gaps.

    `stop`, when set, ends the capture early with what there is, as does the first KeyboardInterrupt. Raises UserError
    where a camera cannot be armed; later failures stop that camera alone and are gaps of the clip.
    """
    raise NotImplementedError
