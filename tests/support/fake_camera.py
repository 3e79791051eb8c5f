"""Cameras without USB for the recorder's tests: a `Link` that plays raw frames, with faults at chosen bytes."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.generators.recorder.frames.layouts import Layout, make_layout
from spike4dgs.generators.recorder.rig_profile import CameraProfile, RigProfile
from spike4dgs.generators.recorder.usb.reads import OK, SHORT, Completion

WIDTH, HEIGHT, FPS = 24, 10, 20000


def rig(n: int, layout: str = "plain", **changes: object) -> RigProfile:
    """Return a rig of n small cameras, the second one the primary, whose reads are 1 KiB."""
    device = {"vendor_id": 0x0403, "product_id": 0x601F, "endpoint_in": 0x82, "endpoint_out": 0x02}
    device |= {"start": (b"go",), "stop": (b"halt",)}
    roles = ["primary" if i == min(1, n - 1) else "secondary" for i in range(n)]
    cameras = tuple(CameraProfile(id=f"cam_{i:02d}", serial=f"S{i}", role=r, **device) for i, r in enumerate(roles))
    profile = RigProfile("test", WIDTH, HEIGHT, layout, cameras, FPS, transfer_bytes=1024, transfers=3, timeout_ms=150)
    return replace(profile, **changes)  # type: ignore[arg-type]


def frames_of(seed: int, layout: Layout, n: int, first_count: int = 0) -> UInt8:
    """Return n raw frames [n, frame_bytes] of random pixels, counted from `first_count`."""
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256, (n, layout.payload_bytes), dtype=np.uint8)
    return layout.pack(pixels, first_count)


@dataclass(eq=False)
class FakeCamera:
    """Sends `stream` from its first byte after each start, `bytes_per_s` fast; silent after the last byte.

    `faults`: stream byte -> status of the read that reaches it; a SHORT one ends there and loses nothing. They happen
    in the second start only, so that the rehearsal passes, unless the camera cannot be restarted.
    """

    camera: CameraProfile
    stream: UInt8  # [bytes]
    faults: Mapping[int, str] = field(default_factory=dict)
    bytes_per_s: float = 50e6
    limit: int | None = None  # stream byte that it does not pass for now
    depth: int = 3
    restartable: bool = True
    stops: bool = True  # at its stop sequence
    log: list[str] = field(default_factory=list)
    starts: int = 0
    begun: float | None = None
    position: int = 0

    def start(self) -> None:
        self.log.append(f"start {self.camera.id}")
        self.starts, self.begun, self.position = self.starts + 1, time.monotonic(), 0

    def stop(self) -> None:
        self.log.append(f"stop {self.camera.id}")
        self.begun = None

    def drain(self) -> bool:
        return self.stops

    def transfers(self) -> FakeTransfers:
        return FakeTransfers(self, self.depth)

    def close(self) -> None:
        self.log.append(f"close {self.camera.id}")

    def read(self, buffer: UInt8) -> Completion | None:
        """Fill a buffer if its bytes have been sent by now."""
        if self.begun is None:
            return None
        faults = self.faults if self.starts > 1 or not self.restartable else {}
        n = min(len(buffer), len(self.stream) - self.position)
        ahead = [at for at in faults if self.position <= at < self.position + n]
        status = faults[min(ahead)] if ahead else OK
        n = min(ahead) - self.position if ahead else n
        if not ahead and n < len(buffer) and self.position == len(self.stream):
            return None
        sent = (time.monotonic() - self.begun) * self.bytes_per_s
        if self.position + n > (sent if self.limit is None else min(sent, self.limit)):
            return None
        buffer[:n] = self.stream[self.position : self.position + n]
        self.position += n
        if ahead and status == SHORT:
            self.faults = {at: s for at, s in self.faults.items() if at != self.position}
        return Completion(n, time.monotonic_ns(), SHORT if status == OK and n < len(buffer) else status)


class FakeTransfers:
    """Reads on a fake camera; they end when they are waited for."""

    def __init__(self, camera: FakeCamera, depth: int) -> None:
        self.camera, self.depth = camera, depth
        self._flying: deque[UInt8] = deque()

    @property
    def in_flight(self) -> int:
        return len(self._flying)

    def submit(self, buffer: UInt8) -> None:
        assert len(self._flying) < self.depth
        self._flying.append(buffer)

    def wait(self, timeout_s: float) -> Completion | None:
        deadline = time.monotonic() + timeout_s
        while (done := self.camera.read(self._flying[0])) is None:
            if time.monotonic() > deadline:
                return None
            time.sleep(2e-4)
        self._flying.popleft()
        return done

    def cancel(self) -> list[Completion]:
        self._flying.clear()
        return []


def rig_of(streams: Sequence[UInt8], profile: RigProfile) -> dict[str, FakeCamera]:
    """Return a fake camera for each stream, by id; all write to one log."""
    log: list[str] = []
    sent = [np.ascontiguousarray(streams[i]).reshape(-1) for i in range(len(profile.cameras))]
    return {c.id: FakeCamera(c, stream, log=log) for c, stream in zip(profile.cameras, sent, strict=True)}


def layout_of(profile: RigProfile) -> Layout:
    return make_layout(profile.layout, profile.width, profile.height)
