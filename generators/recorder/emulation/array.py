"""An array of emulated cameras that share one trigger, made from a rig profile and a scene's streams.

    profile = scene_profile(scene)
    array = EmulatedArray(profile, scene_streams(scene), faults=[Fault("cam_03", "stall", tick=200)])

Secondaries that have been started wait for the primary, whose start is the trigger.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.spikes.bits import orient
from spike4dgs.generators.recorder.emulation.camera import FAULTS, EmulatedCamera, Fault
from spike4dgs.generators.recorder.frames.layouts import make_layout
from spike4dgs.generators.recorder.rig_profile import PRIMARY, SECONDARY, CameraProfile, RigProfile


class EmulatedArray:
    """The cameras of a rig profile, each sending its packed stream `sources[camera id]`.

    `paced`: at the rate of the profile's clock, each off by its `ppm`; otherwise as fast as they are read. Raises
    UserError for a camera without a stream, or one of another size, and for an unknown fault.
    """

    def __init__(
        self,
        profile: RigProfile,
        sources: Mapping[str, UInt8],
        *,
        paced: bool = True,
        faults: Iterable[Fault] = (),
        ppm: Mapping[str, float] | None = None,
        memory_bytes: int | None = None,
    ) -> None:
        faults = tuple(faults)
        _check(profile, sources, faults)
        self.profile, self.faults = profile, faults
        self.cameras = {
            c.id: EmulatedCamera(
                c,
                profile,
                sources[c.id],
                ticks_per_s=profile.fps * (1 + (ppm or {}).get(c.id, 0.0) * 1e-6) if paced else None,
                faults=[f for f in faults if f.camera == c.id],
                memory_bytes=memory_bytes,
            )
            for c in profile.cameras
        }
        self.commands: list[tuple[str, bytes]] = []  # camera and data of each write, in order
        self._armed: set[str] = set()
        self._lock = threading.Lock()

    def has(self, camera: str, kind: str) -> bool:
        """Return whether a camera has a fault of this kind."""
        return any(f.camera == camera and f.kind == kind for f in self.faults)

    def write(self, camera: str, data: bytes) -> bool:
        """Handle a command for a camera. Return False for one that is not in its profile: the camera stalls."""
        c = self.cameras[camera].profile
        with self._lock:
            self.commands.append((camera, data))
            written = tuple(d for name, d in self.commands if name == camera)
            if c.start and written[-len(c.start) :] == c.start:
                self._start(c)
            elif c.stop and written[-len(c.stop) :] == c.stop:
                self._armed.discard(camera)
                self.cameras[camera].end()
            return data in c.start + c.stop

    def _start(self, camera: CameraProfile) -> None:
        primaries = [self.cameras[c.id] for c in self.profile.cameras if c.role == PRIMARY]
        self._armed.add(camera.id)
        if camera.role == PRIMARY or not primaries or any(p.running for p in primaries):
            now = time.monotonic()
            for name in self._armed:
                self.cameras[name].begin(now)
            self._armed.clear()


def camera_profile(name: str, serial: str, role: str) -> CameraProfile:
    """Return an emulated camera's profile: the usual numbers of a bridge, and readable commands."""
    return CameraProfile(
        name,
        serial,
        vendor_id=0x0403,
        product_id=0x601F,
        endpoint_in=0x82,
        endpoint_out=0x01,
        interface=1,
        control_interface=0,
        start=(b"start",),
        stop=(b"stop",),
        role=role,
    )


def scene_profile(scene: Scene, **changes: Any) -> RigProfile:
    """Return the profile of an emulated array that shows a scene; `changes` are fields of `RigProfile`.

    Every camera of the scene, the first as the primary, with its calibration; each keeps the scene's held-out views.
    """
    names = sorted(scene.cameras)
    first = scene.cameras[names[0]]
    facts: dict[str, Any] = {
        "name": f"emulated-{scene.id}",
        "width": first.width,
        "height": first.height,
        "layout": "plain",
        "fps": round(scene.rate_hz),
        "title": scene.meta["title"],
        "licence": scene.meta["licence"],
        "sensor": scene.meta["sensor"]["model"],
        "radiance_gain": scene.radiance_gain,
        "dead_ticks": float(scene.meta["sensor"].get("dead_ticks", 0)),
        "held_out": scene.test,
    }
    cameras = tuple(
        replace(camera_profile(name, f"EMULATED{i:04d}", SECONDARY if i else PRIMARY), calibration=scene.cameras[name])
        for i, name in enumerate(names)
    )
    return RigProfile(cameras=cameras, **{**facts, **changes})


def scene_streams(scene: Scene) -> dict[str, UInt8]:
    """Return the packed streams [n_ticks, bytes] of a scene by camera, rows bottom-up, for an `EmulatedArray`."""
    streams = {name: scene.stream(name) for name in scene.cameras}
    return {name: orient(s.packed, s.width, s.height, not s.rows_bottom_up, False) for name, s in streams.items()}


def _check(profile: RigProfile, sources: Mapping[str, UInt8], faults: tuple[Fault, ...]) -> None:
    size = make_layout(profile.layout, profile.width, profile.height).payload_bytes
    for c in profile.cameras:
        source = sources.get(c.id)
        if source is None or not len(source) or source.shape[1] != size:
            found = "none" if source is None else f"{'x'.join(map(str, source.shape))} bytes"
            raise problem(f"emulated camera {c.id}", f"a stream of {size} bytes a tick", found, "give it one")
    for f in faults:
        if f.kind not in FAULTS or f.camera not in sources:
            expected = f"one of {', '.join(FAULTS)} at one of the cameras {', '.join(sources)}"
            raise problem("fault", expected, f"{f.kind!r} at {f.camera}", "correct it")
