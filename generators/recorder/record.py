"""`record`: a synchronised clip of the array, from USB to a scene folder."""

from __future__ import annotations

import math
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Literal

from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.scene.manifest import NAME as MANIFEST
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.untrusted import MAX_TICKS
from spike4dgs.generators.recorder.capture import capture
from spike4dgs.generators.recorder.checks import check_machine, find_cameras
from spike4dgs.generators.recorder.clip_files import StreamFiles
from spike4dgs.generators.recorder.clip_record import ClipRecord
from spike4dgs.generators.recorder.disk import BUFFER_BYTES
from spike4dgs.generators.recorder.emulation.imperfections import PERFECT, Imperfections
from spike4dgs.generators.recorder.frames.clip import FRAME_TAGS, Clip, Sink
from spike4dgs.generators.recorder.preview import Watch, write_sheet
from spike4dgs.generators.recorder.resources import buffer_seconds, bytes_per_s, real_time
from spike4dgs.generators.recorder.rig_calibration.board_views import open_recording
from spike4dgs.generators.recorder.rig_profile import RigProfile
from spike4dgs.generators.recorder.sources import (
    CLIP,
    NO_LIGHT,
    Light,
    Source,
    Truth,
    emulated_source,
    light_truth,
    real_source,
    truth,
)
from spike4dgs.generators.recorder.sync import SyncReport, fit_arrival
from spike4dgs.generators.recorder.usb.link import Link, open_link
from spike4dgs.generators.recorder.usb.ports import Port, usb_ports
from spike4dgs.generators.recorder.usb.reads import OK

LOST_DATA = 3  # exit code
_ENDING = ("SIGINT", "SIGTERM", "SIGHUP")  # Windows has no SIGHUP
_PATIENCE = 3  # presses of Ctrl-C that abort even the writing of captured data


@dataclass(frozen=True)
class Emulation:
    """What takes the place of a real array.

    Attributes:
        emulate: Record an emulated array that sends this scene's streams, to try all steps without hardware.
        worse_truth: JSON file, outside OUT, that lists what was done to each camera, for reports to compare with.
        seed: Seed of the imperfections. A clip and its flat and dark recordings need the same one.
    """

    emulate: Path | None = None
    worse_truth: Path | None = None
    seed: int = 0


@dataclass(frozen=True)
class Streaming:
    """How data reach the disk.

    Attributes:
        continuous: Write to disk while recording, instead of afterwards from memory.
        buffer_s: With --continuous, seconds of data of all cameras that may wait in memory while the disk stalls; at
            least twice the reads in flight. By default, as much as half of the free memory holds, but at most 10.
    """

    continuous: bool = False
    buffer_s: float | None = None


def record(
    rig: Positional[Path | None] = None,
    *,
    out: Path,
    seconds: float | None = None,
    mode: Literal["clip", "flat", "dark"] = "clip",
    preview: bool = False,
    emulation: OmitArgPrefixes[Emulation] = Emulation(),
    streaming: OmitArgPrefixes[Streaming] = Streaming(),
    light: OmitArgPrefixes[Light] = NO_LIGHT,
    worse: Imperfections = PERFECT,
) -> int:
    """Record all cameras of an array at once: OUT is a scene folder, or streams without poses before the calibration.

    Ctrl-C ends the recording and keeps the captured data. The exit code is 3 where a camera lost data: the gaps are in
    scene.json, and readers refuse the recording unless --allow-gaps.

    Args:
        rig: Rig profile (TOML, see docs/rig_profile.md); optional with --emulate.
        out: Folder of the recording; its name is the scene's.
        seconds: Length; 0.5 or, with --emulate, the scene's. With --continuous, the greatest length.
        mode: flat and dark record uniform light and darkness, for a later clip's --flat and --dark.
        preview: Show spike rates while recording, and write OUT/sheet.png.
        emulation: Instead of a real array.
        streaming: To the disk.
        light: For a scene.
        worse: Imperfections of an emulated array. Such a capture holds nothing of the scene's truth.
    """
    source = _source(rig, mode, emulation, worse, seconds)
    worse_truth, continuous = emulation.worse_truth, streaming.continuous
    if worse_truth is not None and out.resolve() in (worse_truth.resolve(), *worse_truth.resolve().parents):
        raise problem("--worse-truth", f"a file outside {out}", str(worse_truth), "choose another place")
    profile = source.profile if mode == CLIP else _without_poses(source.profile)
    known = light_truth(light, profile)
    length = source.seconds if seconds is None else seconds
    if not 0.5 < length * profile.fps <= MAX_TICKS:
        expected = f"from {1 / profile.fps:g}, one tick, to {MAX_TICKS / profile.fps:g}"
        raise problem("--seconds", expected, f"{length:g}", "record for longer, or shorter")
    n_ticks = round(length * profile.fps)
    profile = _with_buffer(profile, streaming, length)
    copied = (truth(source.scene, n_ticks) | known).files.values()
    emulated = emulation.emulate is not None
    if problems := check_machine(profile, length, out, continuous=continuous, emulated=emulated, copied=copied):
        raise UserError("; ".join(map(str, problems)))
    with StreamFiles(out, profile, n_ticks) as files, _interruptible() as stop:
        links = open_links(profile, usb_ports() if source.ports is None else source.ports)
        with Watch(profile, live=preview) as watch:
            sink = _sink(files, stop) if continuous else None
            with real_time() as urgent:
                clip = capture(profile, links, length, on_state=watch.state, on_rate=watch.rates, stop=stop, sink=sink)
        for camera in clip.cameras:  # without frames in continuous mode: the sink has received them
            files.write_ticks(camera.camera, camera.ticks, camera.frames)
        clip = clip.without(files.flush(clip.n_ticks))
        failures, direct, longest_s = files.failures, files.direct, files.longest_write_s
        sync = fit_arrival(clip, profile.fps)
        files.finish(_described(clip, sync, truth(source.scene, clip.n_ticks) | known))
        if preview:
            _write_preview(out)
    if worse_truth is not None:
        write_json(worse_truth, source.worse_truth)
    _print(clip, sync, continuous)
    if not urgent:
        print("recorded at ordinary priority: busy programs can delay reads; a limit `rtprio` of 1 permits real-time")
    for failure in failures.values():
        print(f"error: {failure}; what it held before is kept", file=sys.stderr)
    cache = f"written {'past' if direct else 'through'} the page cache"
    print(f"{cache}; the disk took {longest_s:.3g} s at most for one buffer of {BUFFER_BYTES >> 20} MiB or less")
    print(f"{clip.n_ticks} ticks of {len(clip.cameras)} cameras: {out}")
    if worse_truth is not None:
        print(f"imperfections: {worse_truth}")
    return 0 if clip.complete and any(c.stats.end == OK for c in clip.cameras) else LOST_DATA


def _source(rig: Path | None, mode: str, emulation: Emulation, worse: Imperfections, seconds: float | None) -> Source:
    if emulation.worse_truth is not None and worse == PERFECT:
        raise problem("--worse-truth", "imperfections, such as --worse.gain 0.02", "none", "add them, or leave it out")
    if emulation.emulate is not None:
        return emulated_source(emulation.emulate, rig, mode, worse, emulation.seed, seconds)
    if worse != PERFECT:
        raise problem("--worse", "--emulate SCENE: no real array is made worse", "none", "add it, or leave out --worse")
    if rig is None:
        fix = "name the array's profile, or try `spike4dgs record --emulate SCENE`"
        raise problem("record", "a rig profile", "none", fix)
    return real_source(rig)


def _without_poses(profile: RigProfile) -> RigProfile:
    """Return the same cameras without calibration: recordings of uniform light and darkness are not scenes."""
    return replace(profile, cameras=tuple(replace(c, calibration=None) for c in profile.cameras))


def _with_buffer(profile: RigProfile, streaming: Streaming, length: float) -> RigProfile:
    """Return the profile with the memory of continuous mode, and print it."""
    buffer_s = streaming.buffer_s
    if not streaming.continuous:
        if buffer_s is not None:
            raise problem("--buffer-s", "--continuous beside it", "none", "add --continuous, or leave it out")
        return profile
    if buffer_s is not None and not 0 < buffer_s < math.inf:
        raise problem("--buffer-s", "seconds above 0", f"{buffer_s:g}", "give the seconds that may wait in memory")
    seconds = buffer_seconds(replace(profile, ring_seconds=buffer_s or profile.ring_seconds), length)
    size = seconds * len(profile.cameras) * bytes_per_s(profile)
    print(f"memory for {seconds:.3g} s of all cameras while the disk stalls: {size / 1e9:.2g} GB")
    return replace(profile, ring_seconds=seconds)


def open_links(profile: RigProfile, ports: Sequence[Port]) -> dict[str, Link]:
    """Return the opened links of all cameras. Closes them if one cannot be opened."""
    devices = find_cameras(profile, ports)
    links: dict[str, Link] = {}
    try:
        for camera in profile.cameras:
            links[camera.id] = open_link(devices[camera.id], camera, profile)
    except BaseException:
        for link in links.values():
            link.close()
        raise
    return links


def _sink(files: StreamFiles, stop: threading.Event) -> Sink:
    """Return a sink that writes during the capture, and ends it when no file accepts data any more."""

    def write(camera: str, first_tick: int, frames: UInt8) -> None:
        files.write(camera, first_tick, frames)
        if files.ended:
            stop.set()

    return write


@contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """Make Ctrl-C set the event, which ends a capture; captured data are still written, unless the user insists.

    A request to end and the end of a terminal do the same.
    """
    stop, presses = threading.Event(), 0

    def press(number: int, frame: FrameType | None) -> None:
        nonlocal presses
        presses += 1
        stop.set()
        if presses >= _PATIENCE:
            raise KeyboardInterrupt

    numbers = [getattr(signal, name) for name in _ENDING if hasattr(signal, name)]
    before = {number: signal.signal(number, press) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _described(clip: Clip, sync: SyncReport, known: Truth) -> ClipRecord:
    return ClipRecord(
        n_ticks=clip.n_ticks,
        gaps=tuple(gap for camera in clip.cameras for gap in camera.gaps),
        sync=sync.as_dict(),
        t0_ns=sync.t0_ns or 0,
        clock="CLOCK_MONOTONIC of the recording computer" if sync.t0_ns is not None else "unknown",
        cameras={c.camera: asdict(c.stats) for c in clip.cameras},
        targets=known.targets,
        extras=known.extras,
        files=known.files,
        splits=known.splits,
    )


def _write_preview(out: Path) -> None:
    """Write the sheet of a recording; a scene's manifest then lists it too."""
    write_sheet(out / "sheet.png", open_recording(out, allow_gaps=True).streams)
    if (out / MANIFEST).is_file():
        write_manifest(out)


def _print(clip: Clip, sync: SyncReport, continuous: bool) -> None:
    from rich.console import Console
    from rich.table import Table

    console, fits = Console(width=120), {fit.camera: fit for fit in sync.cameras}
    title = f"synchronised by {sync.method}" + (", ended early" if clip.interrupted else "")
    columns = "camera", "MB", "lost ticks", "drift, ppm", "offset, us (ticks)", "fullest buffer", "no read, ms", "end"
    table = Table(*columns, title=title)
    for c in clip.cameras:
        s, fit = c.stats, fits[c.camera]
        buffer = f"{s.backlog / s.slots:.0%}" if continuous else "-"  # else it holds the whole clip
        idle = f"{s.idle_mean_ms:.2f}, worst {s.idle_worst_ms:.2f}"
        row = [c.camera, f"{s.bytes / 1e6:.1f}", f"{s.lost_ticks}", fit.drift_text, fit.offset_text]
        table.add_row(*row, buffer, idle, s.end, style="red" if c.gaps else None)
    console.print(table)
    if any(fit.too_short for fit in sync.cameras):
        print("the clip is too short to tell the drift of every clock; a second or more tells it")
    if sync.worst_pair:
        print(f"the arrival times of {' and '.join(sync.worst_pair)} differ most, by {sync.worst_pair_us:.0f} us")
    if apart := ", ".join(fit.camera for fit in sync.cameras if fit.apart):
        contradiction = ", which the frame tags contradict" if sync.method == FRAME_TAGS else ""
        print(f"tick 0 of {apart} arrived far from the others'{contradiction}: check the trigger cable")
    for gap in (gap for c in clip.cameras for gap in c.gaps):
        print(f"gap: {gap.camera} from tick {gap.first_tick}, {gap.ticks} ticks ({gap.reason})")
