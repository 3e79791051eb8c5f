"""Bare `.dat` streams, one for each camera, become a folder of streams or a scene.

No header, 1 bit per pixel, row-major, least significant bit first; a tick takes ceil(width * height / 8) bytes. Rows of
raw dumps may be longer than the image: those of the 400x250 camera have 416 columns.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.exchange.camera_files import read_camera_files
from spike4dgs.benchmark.exchange.recording import Recording, Source, write_recording
from spike4dgs.benchmark.spikes.folder import NAME as STREAM_FOLDER
from spike4dgs.benchmark.spikes.stream import SpikeStream, open_stream
from spike4dgs.benchmark.untrusted import MAX_SIDE, check_ids

_TICKS = 4096  # copied at a time


def import_dat(
    path: Path,
    out: Path,
    *,
    width: int,
    height: int,
    recording: Recording,
    cameras: Path | None = None,
    row_columns: int | None = None,
) -> dict[str, SpikeStream]:
    """Import a bare .dat file, or a folder of them (one per camera), to a new folder; return its streams.

    With `cameras` (COLMAP, OpenCV, Kalibr) it is a scene, else a folder of streams. Of rows of `row_columns`, the
    columns beyond `width` are dropped. Raises UserError before anything is written where files or cameras do not fit.
    """
    recording.check("--cameras", cameras)
    if max(width, height) > MAX_SIDE:
        raise problem("--width and --height", f"at most {MAX_SIDE}", f"{width}, {height}", "correct it")
    stored = width if row_columns is None else row_columns
    if row_columns is not None and (width % 8 or stored % 8 or not width <= stored <= MAX_SIDE):
        expected = f"a multiple of 8 from --width to {MAX_SIDE}, where --width is one too"
        raise problem("--row-columns", expected, f"{stored} of width {width}", "correct it, or leave it out")
    files = {file.stem: file for file in _dat_files(path)}
    check_ids(files, "camera", path, "rename the .dat file, after which the camera is called")
    sources = {name: open_stream(file, stored, height, recording.rate_hz) for name, file in files.items()}
    found = None if cameras is None else read_camera_files(cameras, sorted(sources), (width, height))
    read = {name: Source(width, height, stream.n_ticks, _parts(stream, width)) for name, stream in sources.items()}
    return write_recording(out, read, found, recording, "dat")


def _dat_files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise problem(path, "a .dat file or a folder of them", "no such file", "check the path")
    if (path / STREAM_FOLDER).is_file():
        expected, found_text = "bare .dat files", f"a recording that {STREAM_FOLDER} describes, with its rate and gaps"
        fix = "use the folder as it is, as by inspect, calibrate-rig and fit, or copy its .dat files elsewhere"
        raise problem(path, expected, found_text, fix)
    if not (found := sorted(path.glob("*.dat"))):
        raise problem(path, "a folder with .dat files, one for each camera", "none", "check the path")
    return found


def _parts(stream: SpikeStream, width: int) -> Iterator[UInt8]:
    for start in range(0, stream.n_ticks, _TICKS):
        packed = stream.packed[start : start + _TICKS]
        if width < stream.width:  # both in whole bytes
            packed = packed.reshape(len(packed), stream.height, -1)[:, :, : width // 8].reshape(len(packed), -1)
        yield packed
