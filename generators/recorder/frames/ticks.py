"""Conversion of a camera's bytes to frames with their true ticks, across losses of known and unknown size.

A tick is never guessed. Where the layout has a counter, a frame's tick follows from it, and after any loss the next
whole frame is searched byte by byte. Without a counter, ticks follow from the number of bytes, and a loss of unknown
size ends the camera's recording: everything after it is a gap, because its ticks cannot be known. A loss that neither
tag nor USB status reports, in a camera without tags, goes unnoticed here; arrival times may show it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Int64, UInt8
from spike4dgs.generators.recorder.frames.gaps import INTERRUPTED, OVERFLOW, TORN_FRAME, Gap, merged
from spike4dgs.generators.recorder.frames.layouts import COUNTER, Layout

_NOTHING = np.empty(0, np.uint8)


@dataclass(frozen=True, eq=False)
class Run:
    """Raw frames of consecutive ticks; a view of the bytes of one `feed` unless a frame is split between two."""

    first_tick: int
    frames: UInt8  # [n, frame_bytes]


class TickCounter:
    """Cuts one camera's bytes into frames and numbers them.

    `origin`: the counter of tick 0, where the layout has counters and the cameras have agreed on one; frames before it
    are dropped. Without it, the first whole frame is `first_tick`, and the ticks before it were torn. `from_start`: the
    first byte begins tick 0, so that a loss in it is one as at any other tick; without tags this is so always.

    For example::

        counter = TickCounter(layout, "cam_00")
        for data in transfers:
            for run in counter.feed(data):
                write(run.first_tick, run.frames)
        gaps = counter.finish(n_ticks)
    """

    def __init__(
        self, layout: Layout, camera: str, origin: int | None = None, from_start: bool = False, first_tick: int = 0
    ) -> None:
        self._layout, self._camera = layout, camera
        self._counter = None if origin is None else origin - 1  # of the last frame that was numbered
        self._tick = first_tick - 1  # of the same frame; without counters, of the last that arrived or was skipped
        self._next = 0  # the tick after the last frame that was returned
        self._synced = from_start or not layout.has_tags  # whether the beginning of the next frame is known
        self._ended = False  # lost for good
        self._part = _NOTHING  # the beginning of a frame, or while out of step a possible one
        self._ahead = 0  # bytes to drop before the next frame begins
        self._reason: str | None = TORN_FRAME if first_tick else None  # of the first loss that has not become a gap yet
        self._gaps: list[Gap] = []

    def feed(self, data: UInt8) -> list[Run]:
        """Accept the next bytes [n] of the stream. Return the frames that they complete, in order of their ticks."""
        drop = min(self._ahead, len(data))
        self._ahead -= drop
        runs: list[Run] = []
        data = self._join(data[drop:], runs)
        while not self._ended:
            if not self._synced:
                start = self._layout.find(data)
                if start < 0:
                    self._part = data[max(len(data) - self._layout.frame_bytes + 1, 0) :].copy()
                    break
                data, self._synced = data[start:], True
            size = self._layout.frame_bytes
            frames = data[: len(data) // size * size].reshape(-1, size)
            counts = self._layout.counts(frames)
            torn = np.nonzero(counts < 0)[0]
            good = int(torn[0]) if len(torn) else len(frames)
            self._number(frames[:good], counts[:good], runs)
            data = data[good * size :]
            if not len(torn):
                self._part = data.copy()
                break
            self.lose(TORN_FRAME)
        return runs

    def skip(self, n_bytes: int, reason: str) -> None:
        """Skip `n_bytes` that arrived and were dropped: their number is known, so later frames keep their ticks."""
        self._reason = self._reason or reason
        have, self._part = len(self._part), _NOTHING
        if not self._synced:
            return
        offset = have - self._ahead + n_bytes  # from the start of the frame that was being collected
        lost = max(-(-offset // self._layout.frame_bytes), 0)
        self._ahead = lost * self._layout.frame_bytes - offset
        if not self._layout.count_tags:
            self._tick += lost

    def lose(self, reason: str) -> None:
        """Record that an unknown number of bytes is missing here."""
        self._reason = self._reason or reason
        self._part, self._ahead = _NOTHING, 0
        # Out of step before the first frame nothing can be lost: tick 0 is still to come.
        self._ended = self._ended or (self._synced and not self._layout.count_tags)
        self._synced = False

    @property
    def ended(self) -> bool:
        """True after a loss of unknown size behind which no tick can be known."""
        return self._ended

    def finish(self, n_ticks: int, reason: str = INTERRUPTED) -> tuple[Gap, ...]:
        """Return the gaps of the clip [0, n_ticks): a missing end has the reason `reason` unless a loss caused it."""
        tail = Gap(self._camera, self._next, n_ticks - self._next, self._reason or reason)
        return merged([*self._gaps, tail], n_ticks)

    def _join(self, data: UInt8, runs: list[Run]) -> UInt8:
        """Complete the frame that the earlier bytes began. Return the bytes that are still to be cut."""
        part, self._part = self._part, _NOTHING
        need = self._layout.frame_bytes - len(part)
        if not len(part):
            return data
        if self._synced and len(data) >= need:
            frame = np.concatenate([part, data[:need]])[None]
            counts = self._layout.counts(frame)
            if counts[0] >= 0:
                self._number(frame, counts, runs)
                return data[need:]
            self.lose(TORN_FRAME)
        return np.concatenate([part, data])

    def _number(self, frames: UInt8, counts: Int64, runs: list[Run]) -> None:
        """Append frames [n, frame_bytes] as runs, and the ticks missing before each as a gap."""
        ticks = self._ticks(counts)
        late = np.maximum.accumulate(np.concatenate([[self._next - 1], ticks]))[:-1]
        kept = np.nonzero(ticks > late)[0]  # a counter that goes back or repeats is no new tick
        if not len(kept):
            return
        if self._layout.count_tags:
            self._counter = int(counts[kept[-1]])
        self._tick = int(ticks[kept[-1]])
        breaks = np.nonzero((np.diff(ticks[kept]) != 1) | (np.diff(kept) != 1))[0] + 1
        for part in np.split(kept, breaks):
            first = int(ticks[part[0]])
            if first > self._next:
                # A counter that jumps although every read ended well: the camera or its bridge has lost the frames.
                self._gaps.append(Gap(self._camera, self._next, first - self._next, self._reason or OVERFLOW))
            self._next, self._reason = first + len(part), None
            runs.append(Run(first, frames[part[0] : part[-1] + 1]))

    def _ticks(self, counts: Int64) -> Int64:
        """Return the true ticks of frames with these counters [n], negative before tick 0."""
        if not self._layout.count_tags:
            return self._tick + 1 + np.arange(len(counts))
        if self._counter is None and len(counts):
            self._counter = int(counts[0]) - 1
        ahead = (counts - (self._counter or 0)) % COUNTER
        return self._tick + np.where(ahead < COUNTER // 2, ahead, ahead - COUNTER)
