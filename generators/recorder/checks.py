"""Checks before a capture: the cameras on the bus, and room for their data in kernel memory, memory and on disk."""

from __future__ import annotations

import math
import shutil
from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path

import usb1

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.generators.recorder.frames.layouts import make_layout
from spike4dgs.generators.recorder.resources import buffer_seconds, free_bytes
from spike4dgs.generators.recorder.rig_profile import CameraProfile, RigProfile
from spike4dgs.generators.recorder.usb.link import udev_fix
from spike4dgs.generators.recorder.usb.ports import Port

USBFS_LIMIT = Path("/sys/module/usbcore/parameters/usbfs_memory_mb")

_SPEEDS = {usb1.SPEED_LOW: "Low Speed", usb1.SPEED_FULL: "Full Speed", usb1.SPEED_HIGH: "High Speed (480 Mbit/s)"}
_SPARE_BYTES = 256 << 20  # for the program itself, the buffers of its files, and other programs


def find_cameras(profile: RigProfile, ports: Sequence[Port]) -> dict[str, Port]:
    """Return which of the devices on the bus are the profile's cameras, camera id -> device.

    Raises UserError, which names all cameras concerned, where a serial number is absent or twice on the bus, where a
    link is slower than SuperSpeed, or where the devices cannot be queried.
    """
    found: dict[tuple[int, int, str], list[Port]] = defaultdict(list)
    kinds = {(c.vendor_id, c.product_id) for c in profile.cameras}
    for port in ports:
        if (port.vendor_id, port.product_id) in kinds:
            found[port.vendor_id, port.product_id, _serial(port)].append(port)
    of = {c.id: found.get((c.vendor_id, c.product_id, c.serial), []) for c in profile.cameras}
    cameras = {c.id: c for c in profile.cameras}
    if missing := [cameras[i] for i, devices in of.items() if not devices]:
        others = ", ".join(sorted(serial for _, _, serial in found)) or "none"
        fix = "check cable and power, or correct the serial in the rig profile"
        raise problem(_names(missing), "a device with this serial number", f"only the serials {others}", fix)
    if twice := [cameras[i] for i, devices in of.items() if len(devices) > 1]:
        addresses = ", ".join(d.where for c in twice for d in of[c.id])
        fix = "give each camera a serial number of its own (the bridge's EEPROM), or unplug one"
        raise problem(_names(twice), "one device with this serial number", f"several, at {addresses}", fix)
    if slow := [cameras[i] for i, devices in of.items() if devices[0].speed < usb1.SPEED_SUPER]:
        speeds = ", ".join(sorted({_SPEEDS.get(of[c.id][0].speed, "an unknown speed") for c in slow}))
        fix = "use a USB 3 port and cable, without a USB 2 hub in between"
        raise problem(_names(slow), "a SuperSpeed link (5 Gbit/s)", speeds, fix)
    return {camera: devices[0] for camera, devices in of.items()}


def check_machine(
    profile: RigProfile,
    seconds: float,
    out: Path,
    *,
    continuous: bool = False,
    emulated: bool = False,
    copied: Collection[Path] = (),
) -> list[UserError]:
    """Return what this machine lacks to record `seconds` into the folder `out`, each as an error that states a fix.

    Emulated cameras need no kernel memory for USB. `copied`: files that go there too, besides the streams.
    """
    found = [] if emulated else [check_usb_memory(profile)]
    found += [check_memory(profile, seconds, continuous), check_disk(profile, seconds, out, copied)]
    return [p for p in found if p is not None]


def check_usb_memory(profile: RigProfile, limit_file: Path = USBFS_LIMIT) -> UserError | None:
    """Check the kernel's limit on the memory of all reads in flight: 16 MiB by default; 0 is no limit."""
    try:
        limit_mb = int(limit_file.read_text())
    except (OSError, ValueError):
        return None  # a system without usbfs has no such limit
    need_mb = math.ceil(len(profile.cameras) * profile.transfers * profile.transfer_bytes / (1 << 20))
    if not limit_mb or limit_mb >= need_mb:
        return None
    power = 1 << (2 * need_mb - 1).bit_length()
    fix = f"run: echo {power} | sudo tee {USBFS_LIMIT}"
    return problem("usbfs_memory_mb", f"{need_mb} MiB for the reads in flight", f"{limit_mb} MiB", fix)


def check_memory(profile: RigProfile, seconds: float, continuous: bool, free: int | None = None) -> UserError | None:
    """Check the memory for rings and, where a clip in memory may consist of several parts, for the copy in one part.

    Frames that are lost or belong to no clip lie between the parts where frames have counters. Where a camera cannot be
    stopped, the clip begins anywhere in its ring, and goes on at the ring's start.
    """
    layout = make_layout(profile.layout, profile.width, profile.height)
    free = free_bytes() if free is None else free
    kept_s = buffer_seconds(profile, seconds, free) if continuous else seconds
    copied = not continuous and (layout.count_tags or not all(c.start and c.stop for c in profile.cameras))
    tick_bytes = layout.frame_bytes * (2 if copied else 1)
    flying = profile.transfers * profile.transfer_bytes
    need = len(profile.cameras) * (kept_s * profile.fps * tick_bytes + 2 * flying) + _SPARE_BYTES
    if free >= need:
        return None
    lower = "--buffer-s (or ring_seconds in the profile)" if continuous else "--seconds (or record with --continuous)"
    fix = f"end other programs, or lower {lower}"
    return problem("memory", f"{need / 1e9:.1f} GB for the rings", f"{free / 1e9:.1f} GB free", fix)


def check_disk(profile: RigProfile, seconds: float, out: Path, copied: Collection[Path] = ()) -> UserError | None:
    """Check the disk space for the packed streams of all cameras, what is copied beside them, and a margin."""
    layout = make_layout(profile.layout, profile.width, profile.height)
    need = len(profile.cameras) * seconds * profile.fps * layout.payload_bytes + (16 << 20)
    need += sum(path.stat().st_size for path in copied)
    folder = next(p for p in (out, *out.resolve().parents) if p.exists())
    free = shutil.disk_usage(folder).free
    if free >= need:
        return None
    fix = "free some space, choose another disk, or lower --seconds"
    return problem(out, f"{need / 1e9:.1f} GB of free disk space", f"{free / 1e9:.1f} GB", fix)


def _serial(port: Port) -> str:
    try:
        return port.serial()
    except usb1.USBError as e:
        raise problem(port.where, "a serial number", str(e), udev_fix(port.vendor_id)) from None


def _names(cameras: list[CameraProfile]) -> str:
    return "camera " + ", ".join(f"{c.id} (serial {c.serial})" for c in cameras)
