"""Gaps while recording: their reasons, and their union."""

from __future__ import annotations

from collections.abc import Iterable

from spike4dgs.benchmark.spikes.gaps import Gap

__all__ = ["Gap", "merged"]

OVERFLOW, STALL, UNPLUGGED, TIME_OUT = "overflow", "stall", "unplugged", "time-out"
SHORT_READ, TORN_FRAME, INTERRUPTED = "short read", "torn frame", "interrupted"
DISK = "disk"  # received, but not stored by the disk


def merged(gaps: Iterable[Gap], n_ticks: int) -> tuple[Gap, ...]:
    """Return the gaps sorted, cut to [0, n_ticks), without overlap; adjacent gaps of one camera and reason are joined.

    Where two overlap, the ticks keep the reason of the one that begins first.
    """
    out: list[Gap] = []
    for gap in sorted(gaps):
        last = out[-1] if out and out[-1].camera == gap.camera else None
        first = max(gap.first_tick, 0, last.stop_tick if last else 0)
        ticks = min(gap.stop_tick, n_ticks) - first
        if ticks <= 0:
            continue
        if last and last.stop_tick == first and last.reason == gap.reason:
            out[-1] = Gap(gap.camera, last.first_tick, last.ticks + ticks, gap.reason)
        else:
            out.append(Gap(gap.camera, first, ticks, gap.reason))
    return tuple(out)
