"""What a capture takes of the machine: memory for data that wait for the disk, and real-time priority.

Beside programs that keep all cores busy an ordinary thread may wait for longer than the reads last, and a camera then
loses data unseen. A better nice value does not suffice.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

from spike4dgs.generators.recorder.frames.cutting import SKEW_S
from spike4dgs.generators.recorder.frames.layouts import Layout, make_layout
from spike4dgs.generators.recorder.rig_profile import RigProfile

_SHARE = 0.5  # of the free memory; the rest is left to the page cache and other programs
_SPARE_SLOTS = 8  # of short reads, which fill none: with more of them their blocks are copied
_MOST_S = 10.0  # twice the longest stall that the recorder is tested with


def free_bytes() -> int:
    """Return the memory that programs can take without swapping."""
    return int(psutil.virtual_memory().available)


def bytes_per_s(profile: RigProfile) -> int:
    """Return the rate at which one camera sends."""
    return profile.fps * make_layout(profile.layout, profile.width, profile.height).frame_bytes


def least_seconds(profile: RigProfile) -> float:
    """Return the seconds of data in twice the reads in flight: a ring has no less."""
    return 2 * profile.transfers * profile.transfer_bytes / bytes_per_s(profile)


def buffer_seconds(profile: RigProfile, seconds: float, free: int | None = None) -> float:
    """Return the seconds of data, of all cameras, that may wait in memory during a clip of `seconds`.

    The profile's `ring_seconds`; where it is None, what half of the `free` bytes (those of now) holds, but no more than
    10 s or the whole clip. In any case twice the reads in flight at least.
    """
    least = least_seconds(profile)
    if profile.ring_seconds is not None:
        return max(profile.ring_seconds, least)
    held = _SHARE * (free_bytes() if free is None else free) / (len(profile.cameras) * bytes_per_s(profile))
    return max(min(held, _MOST_S, seconds + least), least)


def ring_slots(profile: RigProfile, layout: Layout, n_ticks: int, continuous: bool) -> int:
    """Return the number of ring slots: for the whole clip, or for `ring_seconds` and twice the reads in flight."""
    ticks = buffer_seconds(profile, n_ticks / profile.fps) * profile.fps if continuous else float(n_ticks)
    if not continuous:  # frames before the tick that all cameras have, or the part of one before the clip
        ticks += SKEW_S * profile.fps if layout.count_tags else 1
    slots = math.ceil(ticks * layout.frame_bytes / profile.transfer_bytes)
    return max(slots, 2 * profile.transfers) if continuous else slots + profile.transfers + _SPARE_SLOTS


_THREADS = Path("/proc/self/task")


@contextmanager
def real_time() -> Iterator[bool]:
    """Run all threads of this process, and those that they start, before ordinary programs.

    All of them, because any thread may hold the interpreter's lock. Yields whether the system permits it: it does for
    root, and for users with a limit `rtprio`. The kernel leaves a share of the time to other programs. A process that
    was started with another policy, by `chrt`, keeps it.
    """
    if hasattr(os, "sched_getscheduler") and os.sched_getscheduler(0) != os.SCHED_OTHER:
        yield os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR)
        return
    permitted = _schedule("SCHED_RR", 1)
    try:
        yield permitted
    finally:
        if permitted:
            _schedule("SCHED_OTHER", 0)


def _schedule(policy: str, priority: int) -> bool:
    """Give all threads this policy. Return False where the system has none, or refuses it."""
    try:
        number = getattr(os, policy)
        for thread in _THREADS.iterdir():
            with suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(int(thread.name), number, os.sched_param(priority))
    except (AttributeError, OSError):
        return False
    return True
