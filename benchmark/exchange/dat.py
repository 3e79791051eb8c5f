"""Bare `.dat` streams, one for each camera, become a folder of streams or a scene.

No header, 1 bit per pixel, row-major, least significant bit first; a tick takes ceil(width * height / 8) bytes.
"""

from __future__ import annotations

from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.exchange.camera_files import read_camera_files
from spike4dgs.benchmark.exchange.recording import Recording, stream_path, write_recording
from spike4dgs.benchmark.files import check_new
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.spikes.stream import SpikeStream, SpikeWriter, open_stream
from spike4dgs.benchmark.untrusted import MAX_SIDE, check_ids

_TICKS = 4096  # copied at a time


def import_dat(
    path: Path, out: Path, *, width: int, height: int, recording: Recording, cameras: Path | None = None
) -> dict[str, SpikeStream]:
    """Import a bare .dat file, or a folder of them (one per camera), to a new folder; return its streams.

    With `cameras` (COLMAP, OpenCV, Kalibr) it is a scene, else a folder of streams. Raises UserError before anything is
    written where files or cameras do not fit.
    """
    recording.check("--cameras", cameras)
    if max(width, height) > MAX_SIDE:
        raise problem("--width and --height", f"at most {MAX_SIDE}", f"{width}, {height}", "correct it")
    files = {file.stem: file for file in _dat_files(path)}
    check_ids(files, "camera", path, "rename the .dat file, after which the camera is called")
    rate_hz, bottom_up = recording.rate_hz, not recording.rows_top_down
    sources = {n: open_stream(file, width, height, rate_hz, rows_bottom_up=bottom_up) for n, file in files.items()}
    found = None if cameras is None else _cameras(cameras, sources, (width, height))
    check_new(out)
    streams = {name: _copied(source, stream_path(out, name, found)) for name, source in sources.items()}
    write_recording(out, streams, found, recording, "dat")
    return streams


def _dat_files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise problem(path, "a .dat file or a folder of them", "no such file", "check the path")
    if not (found := sorted(path.glob("*.dat"))):
        raise problem(path, "a folder with .dat files, one for each camera", "none", "check the path")
    return found


def _cameras(path: Path, sources: dict[str, SpikeStream], size: tuple[int, int]) -> tuple[Camera, ...]:
    """Return the cameras of a scene's streams. Raises UserError also where these are not of one length."""
    lengths = sorted({s.n_ticks for s in sources.values()})
    if len(lengths) > 1:
        found = " and ".join(f"{n} ticks" for n in lengths)
        raise problem("streams", "one length for one scene", found, "cut them to one length")
    return read_camera_files(path, sorted(sources), size)


def _copied(source: SpikeStream, target: Path) -> SpikeStream:
    with SpikeWriter(target, source.width, source.height) as writer:
        for start in range(0, source.n_ticks, _TICKS):
            writer.write(source.packed[start : start + _TICKS])
    bottom_up = source.rows_bottom_up
    return open_stream(target, source.width, source.height, source.rate_hz, rows_bottom_up=bottom_up)
