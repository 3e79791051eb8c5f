"""Capture: one thread for each camera, reads in flight from before the trigger to the last tick, losses recorded.

States: OPEN (devices opened), ARMED (every camera has delivered a block), TRIGGERED (recording), DRAIN (all ticks have
arrived; the remaining data are read and dropped), CLOSED.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.generators.recorder.frames.clip import ARRIVAL_TIMES, FRAME_TAGS, CameraClip, CameraStats, Clip, Sink
from spike4dgs.generators.recorder.frames.cutting import SKEW_S, Cutter, First, agree, aligned, first_frame, joined
from spike4dgs.generators.recorder.frames.delivery import Delivery
from spike4dgs.generators.recorder.frames.gaps import INTERRUPTED
from spike4dgs.generators.recorder.frames.layouts import COUNTER, Layout, make_layout
from spike4dgs.generators.recorder.frames.ring import Ring
from spike4dgs.generators.recorder.frames.ticks import Run
from spike4dgs.generators.recorder.resources import ring_slots
from spike4dgs.generators.recorder.rig_profile import PRIMARY, CameraProfile, RigProfile
from spike4dgs.generators.recorder.sync import Rate, Rates
from spike4dgs.generators.recorder.usb.link import Link
from spike4dgs.generators.recorder.usb.reader import Reader
from spike4dgs.generators.recorder.usb.reads import OK, TIME_OUT

OPEN, ARMED, TRIGGERED, DRAIN, CLOSED = ("OPEN", "ARMED", "TRIGGERED", "DRAIN", "CLOSED")

_POLL_S = 0.005  # interval at which this thread checks the others


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

    A rehearsal comes first: each camera is started, must deliver a block, and is stopped again. Then the secondaries
    are started before the primary, and every camera's first byte begins its first frame. Where a camera cannot be
    stopped, all cameras continue from the rehearsal. Tick 0 is then the first that the counters of all cameras have in
    common; without these, each camera's first whole frame of a read that ended after TRIGGERED.

    Without `sink` all frames stay in memory and `frames` are views of it. With it (continuous mode) a thread passes
    whole frames on during the capture. While the sink waits, `ring_seconds` of data wait in memory; beyond them ticks
    are lost, and recorded as gaps. The reading threads never wait for the sink.

    A camera that fails after the trigger stops alone, and the rest of its clip is a gap: after a stall, too much data
    (babble), unplugging, `timeout_ms` without data, or, without tags, a short read in the middle of a frame. A short
    read between frames, or with tags, loses no data by itself, and is counted.

    `stop`, when set, ends the capture early and keeps the data so far, as does the first KeyboardInterrupt. Raises
    UserError where a camera cannot be armed, or where no tick was captured; errors of the sink are passed on.
    """
    run = _Capture(profile, links, round(seconds * profile.fps), sink, on_rate, stop or threading.Event())
    say = on_state or (lambda state: None)
    try:
        say(OPEN)
        run.arm()
        say(ARMED)
        run.trigger()
        say(TRIGGERED)
        run.record()
        say(DRAIN)
        run.drain()
        return run.clip()
    finally:
        run.close()
        say(CLOSED)


class _Capture:
    """The steps of `capture`, in their order, and their shared state."""

    def __init__(
        self,
        profile: RigProfile,
        links: Mapping[str, Link],
        n_ticks: int,
        sink: Sink | None,
        on_rate: Callable[[Mapping[str, Rate]], None] | None,
        stop: threading.Event,
    ) -> None:
        self.profile, self.n_ticks, self.sink, self.on_rate, self.stop = profile, n_ticks, sink, on_rate, stop
        self.layout = make_layout(profile.layout, profile.width, profile.height)
        _compile(self.layout)
        self.links = {c.id: links[c.id] for c in sorted(profile.cameras, key=_primary) if c.id in links}
        self.restart = all(link.restartable for link in links.values())
        self.from_start = self.restart and not self.layout.count_tags  # the first byte of each camera begins tick 0
        slots = ring_slots(profile, self.layout, n_ticks, continuous=sink is not None)
        self.rings = {camera: Ring(slots, profile.transfer_bytes, compact=sink is None) for camera in self.links}
        self.readers: dict[str, Reader] = {}
        self.cutters: dict[str, Cutter] = {}
        self.delivery: Delivery | None = None
        self.sync = ARRIVAL_TIMES
        self.sending = self.interrupted = False

    def arm(self) -> None:
        """Wait until every camera delivers a block, and stop those that can be restarted."""
        self._start(keep=False)
        while not all(r.proven for r in self.readers.values()) and not self.stop.is_set():
            for camera, reader in self.readers.items():
                if not reader.alive and not reader.proven:
                    self._raise_error(reader)
                    fix = "check its cable, and start and endpoint_in in the rig profile"
                    raise problem(f"camera {camera}", "data after its start sequence", reader.end or "none", fix)
            time.sleep(_POLL_S)
        if self.stop.is_set():
            raise _nothing()
        if self.restart:
            self._halt()
            if sending := self.drain():
                fix = "correct stop in the rig profile, or remove it: then all cameras keep running"
                raise problem(f"camera {sending[0]}", "silence after its stop sequence", "it goes on sending", fix)
            for ring in self.rings.values():
                ring.reset()

    def trigger(self) -> None:
        """Keep all data from here on."""
        if self.restart:
            self._start(keep=True)
        for reader in self.readers.values():
            reader.keep.set()

    def record(self) -> None:
        """Wait for the last bytes of all cameras, and until the sink has received them."""
        rates = Rates(self.layout, self.readers, self.on_rate)
        try:
            while any(r.alive for r in self.readers.values()) and not self.stop.is_set():
                self._agree()
                rates.tell()
                self.stop.wait(_POLL_S)
        except KeyboardInterrupt:
            self.stop.set()
        self.interrupted = self.stop.is_set() and any(r.alive for r in self.readers.values())
        self._halt()
        self._agree(last=True)
        if self.delivery is not None:
            self.delivery.finish()

    def drain(self) -> list[str]:
        """Stop the cameras, the primary first, drop what they still send, and return those that never end."""
        self._stop()
        return [camera for camera, link in self.links.items() if not link.drain()] if self.restart else []

    def clip(self) -> Clip:
        """Return frames, gaps and statistics of every camera."""
        # Continuous mode has popped every block; else all of them still wait in the ring.
        runs = {c: self.cutters[c].cut(ring.blocks()) for c, ring in self.rings.items()}
        n_ticks, cutters = self.n_ticks, self.cutters
        if all(r.end not in (None, OK) and cutters[c].next_tick < n_ticks for c, r in self.readers.items()):
            self.interrupted = True  # as where the array loses its power
        if self.interrupted:
            # A camera that never had a whole frame, or none after a loss, is a gap, and takes nothing from the others.
            going_on = [c for c, reader in self.readers.items() if reader.end == OK and not cutters[c].ended]
            sound = [n for c in going_on if (n := cutters[c].next_tick)]
            n_ticks = min(n_ticks, min(sound) if sound else max(c.next_tick for c in cutters.values()))
        if n_ticks <= 0 or not any(c.next_tick for c in self.cutters.values()):
            raise self._unlike() or _nothing()
        cameras = [self._camera_clip(c.id, runs[c.id], n_ticks) for c in self.profile.cameras if c.id in self.links]
        return Clip(n_ticks, tuple(cameras), self.sync, self.interrupted)

    def close(self) -> None:
        """End all threads, stop the cameras and release the devices, after success or failure."""
        self._halt()
        self._stop()
        if self.delivery is not None:
            self.delivery.abandon()
        for link in self.links.values():
            link.close()

    def _start(self, keep: bool) -> None:
        p = self.profile
        self.readers = {c: Reader(c, link, self.rings[c], self.layout, p.timeout_ms) for c, link in self.links.items()}
        for reader in self.readers.values():
            if keep:
                reader.keep.set()
                if not self.layout.has_tags:  # the first byte begins tick 0
                    reader.wanted = self.n_ticks * self.layout.frame_bytes
            reader.begin()
        for reader in self.readers.values():
            reader.ready.wait()
            self._raise_error(reader)
        self.sending = True
        for link in self.links.values():  # secondaries first
            link.start()
        now = time.monotonic_ns()
        for reader in self.readers.values():
            reader.begun_ns = now

    def _stop(self) -> None:
        for link in reversed(self.links.values()) if self.sending else ():
            link.stop()
        self.sending = False

    def _halt(self) -> None:
        for reader in self.readers.values():
            reader.halt.set()
        for reader in self.readers.values():
            reader.join()

    def _agree(self, last: bool = False) -> None:
        """Set tick 0 and each camera's number of bytes, and begin the delivery, once all cameras have a whole frame."""
        for reader in self.readers.values():
            self._raise_error(reader)
        if self.delivery is not None and self.delivery.error is not None:
            raise self.delivery.error
        if self.cutters:
            return
        firsts = {c: first_frame(self.layout, self.rings[c].blocks(), self.from_start) for c in self.readers}
        if not (last or self._overdue()) and any(f is None and self.readers[c].alive for c, f in firsts.items()):
            return
        found = {c: f for c, f in firsts.items() if f is not None}
        origin = None
        if self.layout.count_tags and found:
            origin = agree([f.counter for f in found.values()], round(SKEW_S * self.profile.fps))
            self.sync = ARRIVAL_TIMES if origin is None else FRAME_TAGS
        for camera, reader in self.readers.items():
            first = found.get(camera) or self._unknown_first(reader, origin or 0)
            size = self.layout.frame_bytes
            ahead = 0 if origin is None else (origin - first.counter) % COUNTER
            # A camera that was started begins with a whole frame: the bytes before a later one are of lost ticks.
            tick = -(-first.position // size) if origin is None and self.restart else 0
            reader.wanted = first.position + (ahead + self.n_ticks - tick) * size
            ring = self.rings[camera]
            self.cutters[camera] = Cutter(camera, self.layout, ring, origin, first.lead, self.from_start, tick)
        if self.sink is not None:
            self.delivery = Delivery(self.sink, self.rings, self.cutters, self.n_ticks)

    def _unknown_first(self, reader: Reader, origin: int) -> First:
        """Return what stands for the first frame of a camera that has none yet: its data count from now on."""
        now = reader.ring.position  # before `origin` is looked at: a first block may arrive in between
        begun = now if reader.origin is None else reader.origin
        return First(begun, 0, origin) if self.layout.has_tags else aligned(self.layout, begun)

    def _overdue(self) -> bool:
        """Return whether one camera is so far ahead that the agreement leaves out another without a frame."""
        most = max(SKEW_S * self.profile.fps * self.layout.frame_bytes, 4 * self.profile.transfer_bytes)
        readers = [r for r in self.readers.values() if r.origin is not None]
        return any(r.ring.position - (r.origin or 0) > most for r in readers)

    def _camera_clip(self, camera: str, runs: Sequence[Run], n_ticks: int) -> CameraClip:
        reader, ring, cutter = self.readers[camera], self.rings[camera], self.cutters[camera]
        end = reader.end or OK
        gaps = cutter.finish(n_ticks, INTERRUPTED if end == OK else end)
        if end == TIME_OUT and not gaps:  # it fell silent after the last tick that was needed
            end = OK
        frames, ticks = joined(runs, n_ticks, self.layout.frame_bytes)
        idle = reader.idle
        stats = CameraStats(
            bytes=ring.position - (reader.origin or 0),
            blocks=reader.blocks,
            short_reads=reader.short_reads,
            backlog=ring.backlog,
            slots=ring.slots,
            lost_ticks=sum(g.ticks for g in gaps),
            idle_mean_ms=idle.total_ns / max(idle.reads, 1) * 1e-6,
            idle_worst_ms=idle.worst_ns * 1e-6,
            starved=idle.starved,
            end=end,
        )
        return CameraClip(camera, frames, ticks, gaps, cutter.arrival, stats)

    def _unlike(self) -> UserError | None:
        """Return the error for data that hold no frame of the layout; None where too few arrived."""
        p, size = self.profile, self.layout.frame_bytes
        most, camera = max((r.ring.position - (r.origin or 0), c) for c, r in self.readers.items())
        if not self.layout.has_tags or most < 2 * size:
            return None
        expected, found = f"frames of layout {p.layout}, {p.width}x{p.height}", f"{most / 1e6:.3g} MB without one"
        return problem(f"camera {camera}", expected, found, "correct layout, width or height in the rig profile")

    @staticmethod
    def _raise_error(reader: Reader) -> None:
        if reader.error is not None:
            raise reader.error


def _nothing() -> UserError:
    return problem("capture", "a whole tick of every camera", "an end before it", "record for longer")


def _compile(layout: Layout) -> None:
    """Compile the layout's kernels before a camera sends."""
    if layout.has_tags:
        frame = layout.pack(np.zeros((1, layout.payload_bytes), np.uint8), 0)
        layout.find(frame[0])
        layout.unpack(frame, np.empty((1, layout.payload_bytes), np.uint8))


def _primary(camera: CameraProfile) -> bool:
    return camera.role == PRIMARY
