"""Sources of `record`: a real array behind USB, or an emulated one that shows a scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.scene.splits import Split, splits_of
from spike4dgs.benchmark.spikes.bits import orient
from spike4dgs.benchmark.spikes.counted_recording import raw
from spike4dgs.benchmark.spikes.folder import open_stream_folder
from spike4dgs.benchmark.untrusted import MAX_GAIN
from spike4dgs.generators.recorder.emulation.array import EmulatedArray, scene_profile, scene_streams
from spike4dgs.generators.recorder.emulation.imperfections import (
    PERFECT,
    Imperfections,
    draw,
    dropped_ticks,
    truth_record,
    with_wrong_calibrations,
)
from spike4dgs.generators.recorder.emulation.ports import emulated_ports
from spike4dgs.generators.recorder.emulation.retiming import worse_stream
from spike4dgs.generators.recorder.frames.layouts import PLAIN, TAGGED_ROWS, make_layout
from spike4dgs.generators.recorder.rig_profile import PACKET_BYTES, PRIMARY, SECONDARY, RigProfile, load_profile
from spike4dgs.generators.recorder.usb.ports import Port

CLIP, FLAT, DARK = ("clip", "flat", "dark")
SECONDS = 0.5  # default length of a recording
_READ_S = 1e-3
_MOST_DROPPING = 10_000_000  # ticks of which some are dropped: each is drawn, and held in memory

_BY_TICK = ("images", "masks", "geometry")  # FOLDER/CAMERA/TICK.*
_WHOLE = ("calibration", "truth")
_EXTRAS = ("ground_truth", "calibration", "instances")  # of scene.json, which describe these folders


@dataclass(frozen=True, eq=False)
class Source:
    """An array to record. `ports`: its devices, None for those on the bus. `seconds`: the default length of a clip.

    `scene` is the scene that an emulated array shows, if its cameras are the scene's own: then the truth is known.
    `worse_truth` is what was done to the cameras of an array with imperfections, which is no part of a recording.
    """

    profile: RigProfile
    ports: Sequence[Port] | None = None
    seconds: float = SECONDS
    scene: Scene | None = None
    worse_truth: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Truth:
    """The part of a recording that comes from the scene it shows, as fields of `ClipRecord`."""

    targets: tuple[Target, ...] = ()
    extras: Mapping[str, dict[str, Any]] = field(default_factory=dict)
    files: Mapping[str, Path] = field(default_factory=dict)
    splits: Mapping[str, Split] = field(default_factory=dict)

    def __or__(self, other: Truth) -> Truth:
        """Return the union; `other` has precedence."""
        return Truth(
            self.targets + other.targets,
            {**self.extras, **other.extras},
            {**self.files, **other.files},
            {**self.splits, **other.splits},
        )


@dataclass(frozen=True)
class Light:
    """Recordings of uniform light and of darkness that become part of the scene.

    Attributes:
        flat: Recording under uniform light that becomes part of the scene, for `calibrate` and for methods.
        dark: The corresponding recording in the dark.
        flat_radiance: Radiance of that light; 1 is white.
    """

    flat: Path | None = None
    dark: Path | None = None
    flat_radiance: float | None = None


NO_LIGHT = Light()


def real_source(rig: Path) -> Source:
    """Return the array of a profile."""
    return Source(load_profile(rig))


def emulated_source(
    path: Path,
    rig: Path | None,
    mode: str,
    worse: Imperfections = PERFECT,
    seed: int = 0,
    seconds: float | None = None,
) -> Source:
    """Return an emulated array that sends a scene's streams at their rate, or its recordings for `FLAT` and `DARK`.

    Its cameras are those of the profile `rig`, or made from the scene; `worse` gives them imperfections for `seconds`,
    by default for what the scene has. Raises UserError where the scene cannot be read, has no such recordings, or does
    not go with the profile.
    """
    scene = open_scene(path)
    if scene.rate_hz != round(scene.rate_hz):
        fix = "emulate another scene"
        raise problem(path, "a whole number of ticks per second, as a rig has", f"{scene.rate_hz:g}", fix)
    streams = scene_streams(scene) if mode == CLIP else _calibration_streams(scene, mode)
    profile = _scene_profile(scene, TAGGED_ROWS if worse.dropped else PLAIN) if rig is None else load_profile(rig)
    if profile.fps != scene.rate_hz:
        fix = "correct fps in the profile, or leave the profile out"
        raise problem(f"rig {profile.name}", f"the scene's {scene.rate_hz:g} ticks per second", f"{profile.fps}", fix)
    ticks = min(len(packed) for packed in streams.values())
    length = ticks / profile.fps
    if worse != PERFECT:
        dropping = seconds if mode == CLIP and worse.dropped else None
        recorded = ticks if dropping is None else round(dropping * profile.fps)
        return replace(_worse_source(profile, streams, recorded, mode, worse, seed), seconds=length)
    shown = scene if rig is None and mode == CLIP else None
    if shown and "calibration" in shown.meta and not shown.meta["sensor"]["rows_bottom_up"]:
        fix = "give a rig profile too: then nothing but the streams is recorded"
        raise problem(path, "calibration recordings with the bottom row first", "the top row first", fix)
    return Source(profile, emulated_ports(EmulatedArray(profile, streams)), length, shown)


def _worse_source(
    profile: RigProfile, streams: Mapping[str, UInt8], ticks: int, mode: str, worse: Imperfections, seed: int
) -> Source:
    """Return an array with imperfections for `ticks`. It shows nothing of a scene's truth, which it would contradict.

    Uniform light and darkness are recorded until nothing is lost: only a clip misses ticks.
    """
    if worse.dropped and not 0 < ticks <= _MOST_DROPPING:
        fix = "record for a shorter time, or leave out --worse.dropped"
        raise problem("--seconds", f"1 to {_MOST_DROPPING} ticks with --worse.dropped", f"{ticks}", fix)
    if worse.dropped and mode == CLIP and not all(c.start and c.stop for c in profile.cameras):
        fix = "add them to the rig, or leave it out: ticks are lost after the rehearsal"
        raise problem("--worse.dropped", f"start and stop sequences of the cameras of {profile.name}", "none", fix)
    cameras = draw(worse, profile, ticks, seed)
    size = profile.width, profile.height
    sent = {name: worse_stream(streams[name], *size, camera, seed, name, mode) for name, camera in cameras.items()}
    array = EmulatedArray(
        profile,
        sent,
        faults=dropped_ticks(cameras, profile) if mode == CLIP else (),
        ppm={name: camera.clock.drift_ppm for name, camera in cameras.items()},
    )
    done = truth_record(worse, seed, cameras, profile.width)
    return Source(with_wrong_calibrations(profile, cameras), emulated_ports(array), worse_truth=done)


def _scene_profile(scene: Scene, layout: str) -> RigProfile:
    """Return a profile whose reads take about a millisecond, as 256 KiB of 400x250 do, also for small scenes.

    A held-out camera is the primary where there is one: its clock is then the scene's, and the truth stays comparable.
    """
    size = make_layout(PLAIN, int(scene.meta["width"]), int(scene.meta["height"])).frame_bytes
    packets = math.ceil(size * scene.rate_hz * _READ_S / PACKET_BYTES)
    rig = scene_profile(scene, layout=layout, transfer_bytes=min(packets * PACKET_BYTES, RigProfile.transfer_bytes))
    primary = scene.test[0] if scene.test else rig.cameras[0].id
    return replace(rig, cameras=tuple(replace(c, role=PRIMARY if c.id == primary else SECONDARY) for c in rig.cameras))


def truth(scene: Scene | None, n_ticks: int) -> Truth:
    """Return ground truth and calibration recordings of a scene for its first `n_ticks` ticks; none without a scene."""
    if scene is None:
        return Truth()
    # A split may hold out cameras, and so have targets, that the default split does not have.
    targets = [t for split in scene.meta["splits"] for t in open_scene(scene.root, split=split).targets]
    names = [n for n in scene.manifest.files if _belongs(n, n_ticks)]
    return Truth(
        targets=tuple(t for t in dict.fromkeys(targets) if t.tick < n_ticks),
        extras={name: scene.meta[name] for name in _EXTRAS if name in scene.meta},
        files={name: scene.manifest.path(name) for name in names},
        splits=splits_of(scene.meta),
    )


def _belongs(name: str, n_ticks: int) -> bool:
    folder = name.partition("/")[0]
    return folder in _WHOLE or (folder in _BY_TICK and int(Path(name).stem) < n_ticks)


def _calibration_streams(scene: Scene, mode: str) -> dict[str, UInt8]:
    streams = {}
    for camera in scene.cameras:
        if (recordings := scene.recordings(camera)) is None:
            fix = "emulate a scene that has calibration/"
            raise problem(scene.root, f"a {mode} recording of each camera", f"none of {camera}", fix)
        s = raw(recordings.flat if mode == FLAT else recordings.dark)
        streams[camera] = orient(s.packed, s.width, s.height, not s.rows_bottom_up, False)
    return streams


def light_truth(light: Light, profile: RigProfile) -> Truth:
    """Return recordings of uniform light and of darkness, if given, as a scene of this array holds them.

    Raises UserError where one is missing, where they are not whole recordings of all its cameras, or where the profile
    has no poses, so that the recording is not a scene.
    """
    flat, dark, flat_radiance = light.flat, light.dark, light.flat_radiance
    given = {"--flat": flat, "--dark": dark, "--flat-radiance": flat_radiance}
    lacks = [name for name, value in given.items() if value is None]
    if len(lacks) == len(given):
        return Truth()
    if flat is None or dark is None or flat_radiance is None:
        expected, found = f"all of {', '.join(given)}, or none", f"no {', '.join(lacks)}"
        raise problem("record", expected, found, "add what is missing")
    if not profile.calibrated:
        fix = "run `spike4dgs calibrate-rig` first, or leave out --flat and --dark"
        raise problem(f"rig {profile.name}", "a calibration, for a scene with --flat and --dark", "none", fix)
    if not 0 < flat_radiance <= MAX_GAIN:
        raise problem(
            "--flat-radiance", f"a positive radiance, {MAX_GAIN:g} at most", f"{flat_radiance:g}", "correct it"
        )
    names = {c.id for c in profile.cameras}
    facts: dict[str, Any] = {"flat_radiance": flat_radiance}
    files: dict[str, Path] = {}
    for mode, folder in ((FLAT, flat), (DARK, dark)):
        streams = open_stream_folder(folder)
        alike = profile.width, profile.height, profile.fps, profile.dead_ticks
        kinds = {(s.width, s.height, s.rate_hz, s.dead_ticks, s.n_ticks, s.rows_bottom_up) for s in streams.values()}
        if not names <= streams.keys() or {k[:4] for k in kinds} != {alike} or len(kinds) > 1:
            wanted, *others = (f"{w}x{h} at {r:g} Hz, {dead:g} dead ticks" for w, h, r, dead, *_ in (alike, *kinds))
            expected = f"recordings of one length by the cameras of {profile.name}, {wanted}"
            found = f"{', '.join(streams)}, {' and '.join(others)}"
            raise problem(folder, expected, found, "record them with this profile")
        *_, facts[f"{mode}_ticks"], rows_bottom_up = kinds.pop()
        if not rows_bottom_up:  # files are copied as they are
            fix = "record them with `record`, or turn their rows over"
            raise problem(folder, "the bottom row first, as in a scene", "the top row first", fix)
        files |= {f"calibration/{mode}/{name}.dat": Path(streams[name].source) for name in sorted(names)}
    return Truth(extras={"calibration": facts}, files=files)
