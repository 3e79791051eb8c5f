"""Conversion of a ring's blocks to frames with true ticks: whole runs at once, as views of the ring where possible."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.generators.recorder.frames.gaps import OVERFLOW, Gap
from spike4dgs.generators.recorder.frames.layouts import COUNTER, Layout
from spike4dgs.generators.recorder.frames.ring import Block, Ring
from spike4dgs.generators.recorder.frames.ticks import Run, TickCounter

# Counters set by one trigger differ by what a camera sends before the last one is started; others differ by anything.
SKEW_S = 0.1


class Cutter:
    """Cuts one camera's blocks into frames, and records which tick was complete when each read ended.

    `origin`, `from_start` and `first_tick` are those of `TickCounter`. `lead` bytes are dropped first: those of a frame
    that began before the recording.
    """

    def __init__(
        self,
        camera: str,
        layout: Layout,
        ring: Ring,
        origin: int | None = None,
        lead: int = 0,
        from_start: bool = False,
        first_tick: int = 0,
    ) -> None:
        self.next_tick = 0  # after the last frame
        self._arrival = array("q")  # pairs; hours of reads fit into memory
        self._counter = TickCounter(layout, camera, origin, from_start, first_tick)
        self._frame_bytes, self._lead = layout.frame_bytes, lead
        self._flat = ring.memory.reshape(-1)
        self._base = self._flat.ctypes.data

    def cut(self, blocks: Sequence[Block]) -> list[Run]:
        """Return the frames that these blocks, the next ones of the stream, complete."""
        runs: list[Run] = []
        group: list[Block] = []  # adjacent in the stream and in memory
        for block in [*blocks, None]:
            if group and (block is None or block.data is None or not _adjacent(group[-1], block)):
                runs += self._feed(group)
                group = []
            if block is not None and block.data is None:
                self._counter.skip(block.bytes, OVERFLOW)
            elif block is not None and block.bytes:
                group.append(block)
        return runs

    def finish(self, n_ticks: int, reason: str) -> tuple[Gap, ...]:
        """Return the gaps of the clip [0, n_ticks); a missing end has the reason `reason`."""
        return self._counter.finish(n_ticks, reason)

    @property
    def arrival(self) -> NDArray[np.int64]:
        """Return [m, 2]: number of complete ticks when a read ended, and its time (CLOCK_MONOTONIC, ns)."""
        return np.array(self._arrival, np.int64).reshape(-1, 2)

    @property
    def ended(self) -> bool:
        """True if no later byte can become a tick."""
        return self._counter.ended

    def _feed(self, group: list[Block]) -> list[Run]:
        data = group[0].data
        if len(group) > 1:
            data = self._flat[_address(group[0]) - self._base : _end(group[-1]) - self._base]
        assert data is not None
        drop = min(self._lead, len(data))
        self._lead -= drop
        runs = self._counter.feed(data[drop:])
        ends = np.array([_end(b) for b in group])
        complete = np.full(len(group), -1)
        for run in runs:
            self.next_tick = run.first_tick + len(run.frames)
            beyond = ends - run.frames.ctypes.data  # from the run's first byte; meaningless for a frame of two groups
            within = (beyond >= 0) & (beyond < run.frames.nbytes + self._frame_bytes)
            complete[within] = run.first_tick + np.minimum(beyond[within] // self._frame_bytes, len(run.frames))
        for tick, block in zip(complete, group, strict=True):
            if tick >= 0:
                self._arrival.extend((int(tick), block.arrival_ns))
        return runs


@dataclass(frozen=True)
class First:
    """A camera's first whole frame: its position in the stream, the kept bytes before it, its counter (0: has none)."""

    position: int
    lead: int
    counter: int


def first_frame(layout: Layout, blocks: Sequence[Block], from_start: bool) -> First | None:
    """Return the first whole frame in these blocks, the first ones kept; None if there is none yet.

    `from_start`: the stream's first byte begins a frame, and the ticks follow from the number of bytes.
    """
    if not blocks:
        return None
    position = blocks[0].position
    if from_start or not layout.has_tags:  # frames have followed each other since the stream's first byte
        return aligned(layout, position)
    data = np.empty(0, np.uint8)
    for block in blocks:
        if block.data is None or len(data) > 3 * layout.frame_bytes:
            break
        data = np.concatenate([data, block.data])
    if (lead := layout.find(data)) < 0:
        return None
    frame = data[lead : lead + layout.frame_bytes]
    return First(position + lead, lead, int(layout.counts(frame[None])[0]))


def aligned(layout: Layout, position: int) -> First:
    """Return the first frame at or after a position of a stream whose first byte begins a frame."""
    lead = -position % layout.frame_bytes
    return First(position + lead, lead, 0)


def agree(counters: Sequence[int], most: int) -> int | None:
    """Return the first counter that every camera has sent, if they differ by no more than `most` frames; else None.

    Counters set to zero by one trigger differ by the frames sent before the recording; others differ by anything.
    """
    first = counters[0]
    ahead = [(c - first + COUNTER // 2) % COUNTER - COUNTER // 2 for c in counters]
    return (first + max(ahead)) % COUNTER if max(ahead) - min(ahead) <= most else None


def joined(runs: Sequence[Run], n_ticks: int, frame_bytes: int) -> tuple[UInt8, NDArray[np.int64]]:
    """Return frames [n, frame_bytes] of all runs within the clip (a view, if there is one run) and their ticks [n]."""
    # What a cancelled read brings after the clip's end is a run of its own, and no reason for a copy.
    cut = [(r.first_tick, r.frames[: n_ticks - r.first_tick]) for r in runs if r.first_tick < n_ticks]
    ticks = [first + np.arange(len(frames), dtype=np.int64) for first, frames in cut]
    if len(cut) == 1:
        return cut[0][1], ticks[0]
    empty = np.empty((0, frame_bytes), np.uint8), np.empty(0, np.int64)
    return np.concatenate([empty[0], *(f for _, f in cut)]), np.concatenate([empty[1], *ticks])


def _adjacent(block: Block, following: Block) -> bool:
    """Return whether one block follows another in the ring's memory; copies of short reads are apart."""
    views = [b.data is not None and b.data.base is not None for b in (block, following)]
    return all(views) and _address(following) == _end(block)


def _address(block: Block) -> int:
    return block.data.ctypes.data if block.data is not None else -1


def _end(block: Block) -> int:
    return _address(block) + block.bytes
