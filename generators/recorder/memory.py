"""Memory for the data that wait for the disk in continuous mode, chosen from what is free."""

from __future__ import annotations

import psutil

from spike4dgs.generators.recorder.clips.layouts import make_layout
from spike4dgs.generators.recorder.rig_profile import RigProfile

_SHARE = 0.5  # of the free memory; the rest is left to the page cache and other programs
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
    10 s or the whole clip.
    """
    if profile.ring_seconds is not None:
        return profile.ring_seconds
    least = least_seconds(profile)
    held = _SHARE * (free_bytes() if free is None else free) / (len(profile.cameras) * bytes_per_s(profile))
    return max(min(held, _MOST_S, seconds + least), least)
