"""The description of a recording: scene.json or stream.json, and the manifest.

With a calibrated rig the folder is a scene, `spike4dgs-scene/1`; without poses it is a folder of streams with its
`stream.json`, which `inspect` and `calibrate-rig` read. The description and the manifest are written last, so a folder
without them is an unfinished recording.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.environment import command_line, environment, harness, utc_now
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.scene.scene import Target
from spike4dgs.benchmark.scene.splits import Split, standard_splits
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene
from spike4dgs.benchmark.spikes.folder import write_stream_folder
from spike4dgs.benchmark.spikes.stream import open_stream
from spike4dgs.generators.recorder.frames.gaps import Gap, merged
from spike4dgs.generators.recorder.rig_profile import RigProfile


@dataclass(frozen=True, eq=False)
class ClipRecord:
    """Facts of a recording besides its streams.

    `cameras` are figures of each camera's capture, by id, for scene.json. `targets`, `extras`, `files` (path in the
    folder -> file to copy) and `splits` are for recordings with known ground truth, such as emulated ones; a rig
    without poses does not write them. Without `splits` they are the standard ones.
    """

    n_ticks: int
    gaps: tuple[Gap, ...]
    sync: Mapping[str, Any]  # "method" at least
    t0_ns: int = 0  # of tick 0, on the clock that `clock` names
    clock: str = "unknown"
    cameras: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    targets: tuple[Target, ...] = ()
    extras: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    files: Mapping[str, Path] = field(default_factory=dict)
    splits: Mapping[str, Split] = field(default_factory=dict)


def write_description(out: Path, profile: RigProfile, record: ClipRecord) -> None:
    """Describe the folder `out`, whose streams are complete."""
    if profile.calibrated:
        _finish_scene(out, profile, record)
    else:
        _finish_streams(out, profile, record)


def gaps_of(camera: str, gaps: Iterable[Gap]) -> tuple[Gap, ...]:
    """Return one camera's gaps, in order."""
    return tuple(sorted(g for g in gaps if g.camera == camera))


def _source(profile: RigProfile, record: ClipRecord) -> dict[str, Any]:
    """Return `source` of the description: the array, the programs, and the result of the capture."""
    lost = {c.id: sum(g.ticks for g in gaps_of(c.id, record.gaps)) for c in profile.cameras}
    cameras = {
        c.id: {"serial": c.serial, "role": c.role, "lost_ticks": lost[c.id], **record.cameras.get(c.id, {})}
        for c in profile.cameras
    }
    return {
        "kind": "recorder",
        "rig": profile.name,
        "layout": profile.layout,
        "recorded": utc_now(),
        "command": command_line(),
        "harness": harness(),
        "environment": {**environment("cpu"), "libusb1": version("libusb1")},
        "cameras": cameras,
    }


def _finish_streams(out: Path, profile: RigProfile, record: ClipRecord) -> None:
    size, gaps, dead = (profile.width, profile.height), merged(record.gaps, record.n_ticks), profile.dead_ticks
    streams = {
        c.id: open_stream(out / f"{c.id}.dat", *size, float(profile.fps), gaps=gaps_of(c.id, gaps), dead_ticks=dead)
        for c in profile.cameras
    }
    facts = {"clock": _clock(record), "sync": _sync(record), "source": _source(profile, record)}
    write_stream_folder(out, streams, facts)


def _finish_scene(out: Path, profile: RigProfile, record: ClipRecord) -> None:
    cameras = tuple(c.calibration for c in profile.cameras if c.calibration is not None)
    for name, path in record.files.items():
        _copy(path, out / name)
    name, splits = out.resolve().name, record.splits
    if not splits and len(profile.held_out) == 1:
        splits = standard_splits(cameras, profile.held_out[0])
    finish_scene(
        out,
        SceneDescription(
            id=name,
            title=profile.title or f"Recording {name}",
            licence=profile.licence,
            cameras=cameras,
            train=tuple(c.id for c in cameras if c.id not in profile.held_out),
            test=profile.held_out,
            splits=splits,
            rate_hz=float(profile.fps),
            n_ticks=record.n_ticks,
            radiance_gain=profile.radiance_gain,
            targets=record.targets,
            sensor={
                "model": profile.sensor,
                "rows_bottom_up": True,
                **({"dead_ticks": profile.dead_ticks} if profile.dead_ticks else {}),
            },
            source=_source(profile, record),
            clock=_clock(record),
            sync=_sync(record),
            gaps=tuple(g.record for g in merged(record.gaps, record.n_ticks)),
            extras=record.extras,
        ),
    )


def _clock(record: ClipRecord) -> dict[str, Any]:
    return {"t0_ns": record.t0_ns, "source": record.clock}


def _sync(record: ClipRecord) -> dict[str, Any]:
    return {"max_error_us": record.sync.get("worst_pair_us"), **record.sync}


def _copy(source: Path, target: Path) -> None:
    with atomic_path(target) as part:
        shutil.copyfile(source, part)
