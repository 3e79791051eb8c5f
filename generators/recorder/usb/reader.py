"""The reading thread of one camera: it keeps reads in flight, and does no work for single frames."""

from __future__ import annotations

import threading
import time
from collections import deque

from spike4dgs.generators.recorder.frames.layouts import Layout
from spike4dgs.generators.recorder.frames.ring import Block, Ring
from spike4dgs.generators.recorder.usb.link import Link
from spike4dgs.generators.recorder.usb.reads import FATAL, OK, SHORT, TIME_OUT, Completion, Transfers

_POLL_S = 0.05  # interval at which a thread that waits for data checks whether to end


class Idle:
    """Times without a read in flight: from the end of the newest read to the submission of the next one."""

    def __init__(self) -> None:
        self.reads = self.starved = self.total_ns = self.worst_ns = 0
        self._submitted = self._ended = 0
        self._arrival_ns = 0  # of the newest read that is known to have ended
        self._open: deque[tuple[int, int]] = deque()  # submissions whose newest earlier read has no known end yet

    def ended(self, arrival_ns: int) -> None:
        """Record that the next read, in the order of submission, has ended."""
        self._ended, self._arrival_ns = self._ended + 1, arrival_ns
        if self._open and self._open[0][0] == self._ended:
            self._add(self._open.popleft()[1] - arrival_ns)

    def submitted(self, now_ns: int, starved: bool, counts: bool) -> None:
        """Record a submitted read; `starved`: no other was in flight. Only those that count are part of the sums."""
        self.reads += counts
        if starved and counts:
            if self._submitted == self._ended:
                self._add(now_ns - self._arrival_ns)
            else:  # the one before has ended too, and its end will be reported
                self._open.append((self._submitted, now_ns))
        self._submitted += 1

    def _add(self, ns: int) -> None:
        self.starved += 1
        self.total_ns += max(ns, 0)
        self.worst_ns = max(self.worst_ns, ns)


class Reader:
    """Reads one camera into its ring until `halt`, `wanted` bytes or a failure; for one start of the camera.

    Other threads set `keep`, `begun_ns`, `wanted` and `halt`, and read the rest. Data before `keep` are dropped.
    """

    def __init__(self, camera: str, link: Link, ring: Ring, layout: Layout, timeout_ms: int) -> None:
        self.camera, self.link, self.ring = camera, link, ring
        self.keep, self.ready, self.halt = threading.Event(), threading.Event(), threading.Event()
        self.begun_ns: int | None = None  # when all cameras had been started: silence counts from then
        self.wanted: int | None = None  # stream position after which no more bytes are needed
        self.origin: int | None = None  # stream position of the first byte that was kept
        self.end: str | None = None  # OK, TIME_OUT, one of reads.FATAL, or SHORT (a torn stream); None while it reads
        self.error: Exception | None = None
        self.newest: Block | None = None
        self.blocks = self.short_reads = 0
        self.idle = Idle()
        self._frame_bytes, self._tags = layout.frame_bytes, layout.has_tags
        self._timeout_ns = timeout_ms * 1_000_000
        self._last_ns = 0  # when the last bytes arrived
        self._thread = threading.Thread(target=self._run, name=camera, daemon=True)

    def begin(self) -> None:
        """Start the thread; `ready` is set when its reads are in flight, or never will be."""
        self._thread.start()

    @property
    def alive(self) -> bool:
        """True while the thread reads."""
        return self._thread.is_alive()

    @property
    def proven(self) -> bool:
        """True if the camera has delivered any data."""
        return self.ring.position > 0

    def join(self) -> None:
        """Wait for the thread's end."""
        if self._thread.ident is not None:
            self._thread.join()

    def _run(self) -> None:
        try:
            transfers = self.link.transfers()
            try:
                for _ in range(transfers.depth):
                    self._submit(transfers, starved=False)
                self.ready.set()
                self._read(transfers)
            finally:
                rest = transfers.cancel()
            if self.end in (None, TIME_OUT):  # these reads follow without a loss: their bytes belong to the stream
                for done in rest:
                    if done.bytes:
                        self._put(done)
        except Exception as e:  # raised again by the capturing thread
            self.error = e
        self.end = self.end or OK
        self.ready.set()

    def _read(self, transfers: Transfers) -> None:
        while not self.halt.is_set() and (self.wanted is None or self.ring.position < self.wanted):
            done = transfers.wait(_POLL_S)
            if done is not None:
                starved = not transfers.in_flight
                self.idle.ended(done.arrival_ns)
                self.end = self._put(done)
            if self.end is None and (done is None or not done.bytes) and self._silent():
                self.end = TIME_OUT
            if self.end is not None:
                break
            if done is not None:
                self._submit(transfers, starved)

    def _submit(self, transfers: Transfers, starved: bool) -> None:
        transfers.submit(self.ring.take())
        self.idle.submitted(time.monotonic_ns(), starved, self.keep.is_set() and self.begun_ns is not None)

    def _put(self, done: Completion) -> str | None:
        """Put a read's bytes into the ring. Return why the camera cannot go on, or None."""
        keep = self.keep.is_set()
        if keep and self.origin is None:
            self.origin = self.ring.position
        block = self.ring.put(done.bytes, done.arrival_ns, keep)
        if done.bytes:
            self.newest, self._last_ns = block, done.arrival_ns
            self.blocks += keep
        if done.status == SHORT:
            self.short_reads += keep
            if not self._tags and self.ring.position % self._frame_bytes:
                return SHORT  # without tags it is unknown whether the rest of the frame follows
        # A time-out of one read is no end: it may have been queued before the camera was started.
        return done.status if done.status in FATAL else None

    def _silent(self) -> bool:
        now = time.monotonic_ns()
        return self.begun_ns is not None and now - max(self.begun_ns, self._last_ns) > self._timeout_ns
