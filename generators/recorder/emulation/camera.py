"""An emulated camera behind the USB plug: its data, their timing, and its faults.

It sends the ticks of a packed stream in an endless loop; its first frame after a start is tick 0 of the stream.
`array.py` joins cameras to an array, `ports.py` shows them as devices on a bus; this module does not depend on how
a camera is read. Not modelled: the time that a bus takes.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.spikes.bits import orient
from spike4dgs.generators.recorder.frames.gaps import OVERFLOW, SHORT_READ, STALL, TIME_OUT, UNPLUGGED
from spike4dgs.generators.recorder.frames.layouts import make_layout
from spike4dgs.generators.recorder.rig_profile import TOP_DOWN, CameraProfile, RigProfile
from spike4dgs.generators.recorder.usb.reads import CANCELLED, OK

LOST = "lost bytes"
MISSING, DUPLICATE, HIGH_SPEED = "missing", "duplicate serial", "high speed"
_IN_STREAM = (STALL, OVERFLOW, UNPLUGGED, TIME_OUT, SHORT_READ, LOST)
FAULTS = (*_IN_STREAM, MISSING, DUPLICATE, HIGH_SPEED)

_HELD_BYTES = 16384  # that a stopped camera still delivers: the memory of its USB bridge


@dataclass(frozen=True)
class Fault:
    """One fault of one camera.

    - "stall", "overflow", "unplugged": the read that reaches byte `offset` of `tick` ends so, with the bytes before it.
    - "time-out": no data arrive from there on.
    - "short read": that read ends early; `lost` bytes are missing before the next one.
    - "lost bytes": `lost` bytes are missing there, and no status reports it.
    - "missing", "duplicate serial", "high speed": the camera is absent, is present twice, or is on a slow link.

    `start` counts the start sequences before the fault: a recording begins with the second (1), after a rehearsal (0).
    """

    camera: str
    kind: str
    tick: int = 0
    offset: int = 0
    lost: int = 0
    start: int = 1


@dataclass(frozen=True)
class ReadPlan:
    """The end of a read, in positions of the stream since the camera's start."""

    pieces: tuple[tuple[int, int], ...]  # [from, to) of the bytes that it brings
    after: int  # position of the byte that follows
    faults: int  # that it reaches
    status: str


class EmulatedCamera:
    """One camera: started and stopped by commands, read by the first who asks.

    `source` is [n_ticks, payload_bytes], packed as on disk (rows bottom-up). `ticks_per_s` None: data are available as
    soon as they are requested. `memory_bytes`: capacity while no read is in flight; whole frames beyond it are lost
    (None: no frame is lost).
    """

    def __init__(
        self,
        camera: CameraProfile,
        rig: RigProfile,
        source: UInt8,
        *,
        ticks_per_s: float | None = None,
        faults: Iterable[Fault] = (),
        memory_bytes: int | None = None,
    ) -> None:
        self.profile = camera
        self.layout = make_layout(rig.layout, rig.width, rig.height)
        self.changed = threading.Condition()  # held while the state is used, and notified when it changes
        self._source = orient(source, rig.width, rig.height, camera.rows == TOP_DOWN, camera.mirrored)
        self._frame = self.layout.frame_bytes
        self._wire = self._source.reshape(-1) if self.layout.packed else None
        self._rate = None if ticks_per_s is None else ticks_per_s * self._frame  # bytes per second
        self._all_faults, self._memory = tuple(faults), memory_bytes
        self._starts = 0
        self._begun: float | None = None  # time.monotonic() of the first byte; None while it is stopped
        self._at = 0  # position of the next byte to be read
        self._faults: list[tuple[int, Fault]] = []  # still ahead, by position
        self._held = np.empty(0, np.uint8)  # from before the last stop
        self.dead: str | None = None  # the fault that ended it
        self.lost_bytes = 0  # because no read was in flight
        if not camera.start:
            self.begin(time.monotonic())

    @property
    def running(self) -> bool:
        """True while the camera sends."""
        return self._begun is not None

    def begin(self, now_s: float) -> None:
        """Send from tick 0."""
        with self.changed:
            mine = [f for f in self._all_faults if f.start == self._starts and f.kind in _IN_STREAM]
            self._faults = sorted(((f.tick * self._frame + f.offset, f) for f in mine), key=lambda item: item[0])
            self._starts += 1
            self._begun, self._at = now_s, 0
            self.changed.notify_all()

    def end(self) -> None:
        """Stop sending, except for the bytes that the USB bridge holds."""
        with self.changed:
            if self._begun is not None and self.dead is None:
                n = min(_HELD_BYTES, self._produced() - self._at)
                self._held = self._bytes(self._at, self._at + n)
            self._begun = None
            self.changed.notify_all()

    def due_s(self, n: int) -> float:
        """Return when a read of `n` bytes ends by itself (clock of time.monotonic()); infinite where it never does."""
        if self.dead or len(self._held):
            return 0.0
        if self._begun is None:
            return math.inf
        plan = self._plan(n)
        if plan.status == TIME_OUT:
            return math.inf
        return 0.0 if self._rate is None else self._begun + plan.pieces[-1][1] / self._rate

    def read(self, into: UInt8, cut: bool = False) -> tuple[int, str] | None:
        """End a read of len(into) bytes. Return their number and its status, or None if it is neither due nor `cut`."""
        if len(self._held):
            n = min(len(self._held), len(into))
            into[:n], self._held = self._held[:n], self._held[n:]
            return n, OK if n == len(into) else SHORT_READ
        if self.dead:
            return 0, self.dead
        due = self.due_s(len(into)) <= time.monotonic()
        if not (due or cut):
            return None
        if self._begun is None:
            return 0, CANCELLED
        plan = self._plan(len(into))
        return self._fill(into, plan) if due else self._fill_until(into, plan)

    def ended(self, reads: int, size: int) -> int:
        """Return how many of the reads of one size in flight have ended by now; 0 without a clock."""
        if self._rate is None and not self.dead:
            return 0
        if self.dead or self._faults or len(self._held):
            now = time.monotonic()
            return sum(self.due_s(size * (i + 1)) <= now for i in range(reads))
        return 0 if self._begun is None else min((self._produced() - self._at) // size, reads)

    def lose_unread(self, asked: int) -> None:
        """Lose the frames that had no room, when a read is submitted behind others for `asked` bytes in all."""
        if self._memory is None or self._rate is None or self._begun is None:
            return
        room = max(asked + self._memory, -self._at % self._frame)  # a frame that has begun is sent to its end
        plan = self._plan(room + 1)  # one byte more, so that a loss at this very position counts
        first = plan.after // self._frame
        lost = (self._produced() // self._frame - first) * self._frame
        if plan.status == OK and lost > 0:
            hole = Fault(self.profile.id, LOST, first, lost=lost)
            self._faults = sorted([*self._faults, (first * self._frame, hole)], key=lambda item: item[0])
            self.lost_bytes += lost

    def _produced(self) -> int:
        """Return the number of bytes that it has sent or could have sent since its start."""
        if self._rate is None or self._begun is None:
            return 1 << 62
        return int((time.monotonic() - self._begun) * self._rate)

    def _plan(self, n: int) -> ReadPlan:
        at, met = self._at, 0
        pieces: list[tuple[int, int]] = []
        for position, fault in self._faults:
            stop = max(position, at)
            if stop >= at + n:
                break
            pieces.append((at, stop))
            n, met = n - (stop - at), met + 1
            if fault.kind != LOST:
                return ReadPlan(tuple(pieces), stop + fault.lost, met, fault.kind)
            at = stop + fault.lost
        return ReadPlan((*pieces, (at, at + n)), at + n, met, OK)

    def _fill(self, into: UInt8, plan: ReadPlan) -> tuple[int, str]:
        n = self._copy(into, plan.pieces)
        self._at, self._faults = plan.after, self._faults[plan.faults :]
        if plan.status not in (OK, SHORT_READ):
            self.dead = plan.status
        return n, plan.status

    def _fill_until(self, into: UInt8, plan: ReadPlan) -> tuple[int, str]:
        """Copy the bytes that have arrived of a read that is not due."""
        have = self._produced()
        pieces = tuple((a, min(b, have)) for a, b in plan.pieces if a < have)
        n = self._copy(into, pieces)
        self._at = pieces[-1][1] if pieces else self._at
        self._faults = [(p, f) for p, f in self._faults if p >= self._at]
        return n, CANCELLED

    def _copy(self, into: UInt8, pieces: Iterable[tuple[int, int]]) -> int:
        n = 0
        for a, b in pieces:
            while a < b:
                part = self._some(a, b)
                into[n : n + len(part)] = part
                n, a = n + len(part), a + len(part)
        return n

    def _some(self, a: int, b: int) -> UInt8:
        """Return bytes from position a on, at most b - a; a view where frames are sent as they are stored."""
        if self._wire is None:
            return self._bytes(a, b)
        i = a % len(self._wire)  # the stream begins anew at its end
        return self._wire[i : i + b - a]

    def _bytes(self, a: int, b: int) -> UInt8:
        first, last = a // self._frame, -(-b // self._frame)
        ticks = self._source[np.arange(first, last) % len(self._source)]
        raw = self.layout.pack(ticks, first).reshape(-1)
        return raw[a - first * self._frame : b - first * self._frame]
