"""The rig profile: everything about an array of cameras that cannot be asked over USB, in one TOML file.

docs/rig_profile.md describes every key; docs/rig_example.toml is a whole profile.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from spike4dgs.benchmark.cameras import Camera

PRIMARY, SECONDARY = "primary", "secondary"
BOTTOM_UP, TOP_DOWN = "bottom-up", "top-down"


@dataclass(frozen=True, eq=False)
class CameraProfile:
    """One camera: how it is found, how it is started and stopped, how its pictures lie, and its calibration.

    `start` and `stop` are written to `endpoint_out`, one bulk write for each item. `rows` and `mirrored` tell how the
    camera sends its picture; streams on disk are always bottom-up and not mirrored.
    """

    id: str
    serial: str
    vendor_id: int
    product_id: int
    interface: int
    control_interface: int | None  # of endpoint_out, where it is another one than `interface`
    endpoint_in: int
    endpoint_out: int | None
    start: tuple[bytes, ...]
    stop: tuple[bytes, ...]
    role: str  # "primary" (makes the trigger) or "secondary"
    rows: str  # "bottom-up" or "top-down"
    mirrored: bool
    calibration: Camera | None = None  # intrinsics and pose
    maps: Path | None = None  # .npz with gain [H, W] and dark [H, W] (spikes per tick), as `calibrate` writes it


@dataclass(frozen=True, eq=False)
class RigProfile:
    """An array of cameras that share size, rate and frame layout, and the facts of the scenes that it records."""

    name: str
    width: int
    height: int
    layout: str  # a name that `make_layout` knows
    cameras: tuple[CameraProfile, ...]
    fps: int = 20000
    title: str = ""
    licence: str = "unknown"
    sensor: str = "unknown"  # sensor.model of scene.json
    radiance_gain: float = 1.0  # spikes per tick of a pixel that sees white
    held_out: tuple[str, ...] = ()  # cameras that recordings hold out for testing
    transfer_bytes: int = 262144  # of one bulk read
    transfers: int = 16  # reads in flight per camera
    ring_seconds: float = 0.5  # memory per camera
    timeout_ms: int = 500  # without any data, after which a camera counts as gone
