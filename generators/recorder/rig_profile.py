"""The rig profile: all facts of an array of cameras that USB does not report, in one TOML file.

docs/rig_profile.md describes every key; docs/rig_example.toml is a whole profile.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import Camera, check_lens, check_rotation
from spike4dgs.benchmark.scene.lens import NAMES, make_distortion
from spike4dgs.benchmark.spikes.sensor_model import MOST_DEAD_TICKS
from spike4dgs.benchmark.untrusted import ID, MAX_SIDE, check_ids, is_id, shown
from spike4dgs.generators.recorder.frames.layouts import LAYOUTS, make_layout
from spike4dgs.generators.recorder.toml_table import (
    FLAG,
    TEXT,
    Kind,
    Table,
    choice,
    matching,
    number,
    read_toml,
    tuple_of,
    values,
    whole,
)

SCHEMA = "spike4dgs-rig/1"
CALIBRATION_SCHEMA = "spike4dgs-rig-calibration/1"
PRIMARY, SECONDARY = "primary", "secondary"
BOTTOM_UP, TOP_DOWN = "bottom-up", "top-down"
PACKET_BYTES = 1024  # of a SuperSpeed bulk endpoint: a read of another multiple ends in an overflow error

_ID = matching(f"a name of {ID}", is_id)
_POSITIVE = number(0, 1e12, "a positive number")
_FINITE = number(-1e12, 1e12, "a finite number")
_VECTOR = tuple_of(_FINITE, "a list of numbers")
_LENS = Kind(f"a list of {', '.join(NAMES)}, or of the first of them", lambda v: make_distortion(_VECTOR.read(v)))
_COMMANDS = values(
    'a list of commands in hexadecimal digits, such as "00 ff"',
    lambda v: isinstance(v, list) and all(map(bytes.fromhex, v)),
    lambda v: tuple(map(bytes.fromhex, v)),
)
_RIG: dict[str, Kind[Any]] = {
    "name": _ID,
    "width": whole(1, MAX_SIDE),
    "height": whole(1, MAX_SIDE),
    "layout": choice(*LAYOUTS),
    "fps": whole(1, 1_000_000),
    "title": TEXT,
    "licence": TEXT,
    "sensor": TEXT,
    "radiance_gain": number(0, 1, "a number above 0, 1 at most"),
    "dead_ticks": values(
        f"a number from 0 to {MOST_DEAD_TICKS}",
        lambda v: type(v) in (int, float) and 0 <= v <= MOST_DEAD_TICKS,
        float,
    ),
    "held_out": tuple_of(_ID, "a list of cameras"),
}
_TRANSFER: dict[str, Kind[Any]] = {
    "bytes": values(
        f"a multiple of {PACKET_BYTES} bytes, 64 MiB at most",
        lambda v: type(v) is int and PACKET_BYTES <= v <= 1 << 26 and v % PACKET_BYTES == 0,
    ),
    "in_flight": whole(1, 256),
    "ring_seconds": number(0, 3600, "seconds, 3600 at most"),
    "timeout_ms": whole(1, 600_000),
}
_TRANSFER_FIELDS = {"bytes": "transfer_bytes", "in_flight": "transfers"}  # whose key has another name
_CAMERA: dict[str, Kind[Any]] = {
    "serial": TEXT,
    "vendor_id": whole(0, 0xFFFF),
    "product_id": whole(0, 0xFFFF),
    "interface": whole(0, 255),
    "control_interface": whole(0, 255),
    "endpoint_in": whole(0x81, 0x8F),
    "endpoint_out": whole(0x01, 0x0F),
    "start": _COMMANDS,
    "stop": _COMMANDS,
    "role": choice(PRIMARY, SECONDARY),
    "rows": choice(BOTTOM_UP, TOP_DOWN),
    "mirrored": FLAG,
}


@dataclass(frozen=True, eq=False)
class CameraProfile:
    """One camera: how to find, start and stop it, the orientation of its images, and its calibration.

    `start` and `stop` are written to `endpoint_out`, one bulk write for each item. `rows` and `mirrored` state how the
    camera sends its image; streams on disk are always bottom-up and not mirrored.
    """

    id: str
    serial: str
    vendor_id: int
    product_id: int
    endpoint_in: int
    endpoint_out: int | None = None
    interface: int = 0
    control_interface: int | None = None  # of endpoint_out, if it is not `interface`
    start: tuple[bytes, ...] = ()
    stop: tuple[bytes, ...] = ()
    role: str = SECONDARY  # or "primary", which makes the trigger
    rows: str = BOTTOM_UP  # or "top-down"
    mirrored: bool = False
    calibration: Camera | None = None  # intrinsics and pose


@dataclass(frozen=True, eq=False)
class RigProfile:
    """An array of cameras that share size, rate and frame layout, and the facts of the scenes that it records."""

    name: str
    width: int
    height: int
    layout: str  # a name for `make_layout`
    cameras: tuple[CameraProfile, ...]
    fps: int = 20000
    title: str = ""
    licence: str = "unknown"
    sensor: str = "unknown"  # sensor.model of scene.json
    radiance_gain: float = 1.0  # spikes per tick of a pixel that sees white
    dead_ticks: float = 0.0  # after each spike, in which a pixel gathers no light
    held_out: tuple[str, ...] = ()  # cameras that recordings hold out for testing
    transfer_bytes: int = 262144  # of one bulk read
    transfers: int = 16  # reads in flight per camera
    ring_seconds: float | None = None  # memory per camera in continuous mode; None: chosen from what is free
    timeout_ms: int = 500  # without any data, after which a camera counts as gone

    def camera(self, id: str) -> CameraProfile:
        """Return the camera of that name. Raises KeyError where there is none."""
        return {c.id: c for c in self.cameras}[id]

    @property
    def calibrated(self) -> bool:
        """True if every camera has intrinsics and a pose, so that a recording can become a scene."""
        return all(c.calibration is not None for c in self.cameras)


def load_profile(path: Path) -> RigProfile:
    """Read and validate a rig profile; files that it names are relative to its folder.

    Raises UserError for any error: one line with file, key, expected and found value.
    """
    top = read_toml(path, "a rig profile")
    top.take("schema", choice(SCHEMA))
    facts = top.fields(_RIG, ("name", "width", "height", "layout"))
    cameras = _read_cameras(top, facts["width"], facts["height"])
    transfer = top.table("transfer") or Table(path, "transfer", {})
    reads = {_TRANSFER_FIELDS.get(key, key): value for key, value in transfer.fields(_TRANSFER, ()).items()}
    profile = RigProfile(**facts, cameras=cameras, **reads)
    transfer.close()
    top.close()
    _check_whole(top, profile)
    return profile


def calibration_toml(cameras: Iterable[Camera]) -> str:
    """Return intrinsics and poses as the file of a profile's key `calibration`; reading it back gives equal numbers."""
    lines = [f'schema = "{CALIBRATION_SCHEMA}"']
    for c in cameras:
        values = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "rotation": c.R.tolist(), "translation": c.t.tolist()}
        if c.distortion:
            values["distortion"] = list(c.distortion)
        # Python writes the shortest digits that give the same number back, and TOML reads them.
        lines += ["", f'[camera."{c.id}"]', *(f"{key} = {_plain(value)}" for key, value in values.items())]
    return "\n".join(lines) + "\n"


def read_calibration(path: Path, width: int, height: int) -> dict[str, Camera]:
    """Return the cameras of a file that `calibration_toml` made, by id. Raises UserError where it is no such file."""
    top = read_toml(path, "the calibration of a rig")
    top.take("schema", choice(CALIBRATION_SCHEMA))
    tables = top.table("camera") or Table(path, "camera", {})
    top.close()
    return {id: _read_calibration(table, id, width, height) for id, table in tables.items()}


def _plain(value: Any) -> str:
    return f"[{', '.join(map(_plain, value))}]" if isinstance(value, list) else repr(float(value))


# ------------------------------------------------------------ cameras


def _read_cameras(top: Table, width: int, height: int) -> tuple[CameraProfile, ...]:
    folder = top.path.parent
    defaults = top.table("defaults")
    shared = defaults.rest() if defaults else {}
    name = top.get("calibration", TEXT, None)
    known = read_calibration(folder / name, width, height) if name else {}
    if unique := {"id", "serial", "calibration"} & set(shared):
        raise top.error(f"defaults.{min(unique)}", "common keys of the cameras", "a key of each camera", "move it")
    tables = top.tables("camera")
    if not tables:
        raise top.error("camera", "a table [[camera]] for each camera", "none", "add them")
    return tuple(_read_camera(table.with_defaults(shared), known, width, height) for table in tables)


def _read_camera(table: Table, known: dict[str, Camera], width: int, height: int) -> CameraProfile:
    id = table.take("id", _ID)
    own = table.table("calibration")
    if own and id in known:
        raise table.error("calibration", "one calibration of a camera", "another in the profile's calibration file")
    camera = CameraProfile(
        id=id,
        **table.fields(_CAMERA, ("serial", "vendor_id", "product_id", "endpoint_in")),
        calibration=_read_calibration(own, id, width, height) if own else known.get(id),
    )
    table.close()
    if (camera.start or camera.stop) and camera.endpoint_out is None:
        raise table.error("endpoint_out", "an endpoint for the start and stop sequences", "none", "add it")
    return camera


def _read_calibration(table: Table, id: str, width: int, height: int) -> Camera:
    fx, fy = (table.take(name, _POSITIVE) for name in ("fx", "fy"))
    cx, cy = (table.take(name, _FINITE) for name in ("cx", "cy"))
    rotation = table.take("rotation", Kind("three rows of three numbers", lambda v: _array(v, (3, 3))))
    translation = table.take("translation", Kind("three numbers", lambda v: _array(v, (3,))))
    lens = table.get("distortion", _LENS, ())
    table.close()
    try:
        check_rotation(rotation, "")
    except UserError:
        raise table.error("rotation", "a rotation matrix (world to camera)", shown(rotation.tolist())) from None
    camera = Camera(id, width, height, fx, fy, cx, cy, rotation, translation, lens)
    check_lens(camera, table.path)
    return camera


def _array(value: Any, shape: tuple[int, ...]) -> Float64:
    rows = tuple_of(_VECTOR, "").read(value) if len(shape) == 2 else _VECTOR.read(value)
    array = np.array(rows, np.float64)  # ValueError where rows differ in length
    if array.shape != shape:
        raise ValueError
    return array


# ------------------------------------------------------------ checks across keys


def _check_whole(top: Table, p: RigProfile) -> None:
    """Check facts across keys: names used twice, roles, sizes that do not go together."""
    try:
        layout = make_layout(p.layout, p.width, p.height)
    except UserError as e:
        raise UserError(f"{top.path}, key layout: {e}") from None
    if not layout.has_tags and (unknown := [c.id for c in p.cameras if not c.start]):
        expected = f"a start sequence, after which a frame of layout {p.layout} begins"
        raise top.error("camera.start", expected, f"none of {', '.join(unknown)}", "add it, or take a layout with tags")
    if (read_ms := 1e3 * p.transfer_bytes / (p.fps * layout.frame_bytes)) > p.timeout_ms / 2:
        expected, fix = f"reads of half of timeout_ms ({p.timeout_ms}) at most", "lower bytes or raise timeout_ms"
        raise top.error("transfer.bytes", expected, f"{read_ms:.0f} ms for {p.transfer_bytes} bytes", fix)
    for key, names in (("id", [c.id for c in p.cameras]), ("serial", [c.serial for c in p.cameras])):
        if twice := _twice(names):
            raise top.error(f"camera.{key}", "another one for each camera", f"{twice!r} twice")
    check_ids([c.id for c in p.cameras], "camera", f"{top.path}, key camera.id")
    if (primaries := [c.id for c in p.cameras if c.role == PRIMARY]) != primaries[:1] or not primaries:
        found = ", ".join(primaries) or "none"
        raise top.error("camera.role", "one primary camera", found, 'give role = "primary" to the one that triggers')
    ids = {c.id for c in p.cameras}
    if _twice(p.held_out) or not set(p.held_out) < ids:
        raise top.error("held_out", "some of the cameras, each once, and not all", ", ".join(p.held_out))
    bare = [c.id for c in p.cameras if c.calibration is None]
    if bare and len(bare) < len(p.cameras):
        expected, found = "intrinsics and poses of all cameras, or of none", f"none of {', '.join(bare)}"
        raise top.error("calibration", expected, found, "calibrate the rig")


def _twice(values: Sequence[str]) -> str | None:
    return next((v for i, v in enumerate(values) if v in values[:i]), None)
