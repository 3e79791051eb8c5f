"""`import-dat`: bare `.dat` streams, one for each camera, as a folder of streams or a scene."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.exchange.camera_files import read_camera_files
from spike4dgs.benchmark.exchange.spikecv import write_recorded_scene
from spike4dgs.benchmark.files import check_new
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.writer import stream_name
from spike4dgs.benchmark.spikes.folder import write_stream_folder
from spike4dgs.benchmark.spikes.stream import SpikeStream, SpikeWriter, open_stream
from spike4dgs.benchmark.untrusted.names import check_ids
from spike4dgs.benchmark.untrusted.numbers import MAX_GAIN, MAX_HZ, MAX_SIDE

_TICKS = 4096  # copied at a time


def import_dat(
    path: Positional[Path],
    *,
    width: int,
    height: int,
    rate_hz: float,
    out: Path,
    cameras: Path | None = None,
    radiance_gain: float = 1.0,
    rows_top_down: bool = False,
    licence: str = "unknown",
) -> int:
    """Import a bare .dat file, or a folder of them (one per camera), as a folder of streams or a scene folder.

    The layout is that of `inspect` and of SpikeCV: no header, 1 bit per pixel, row-major, least significant bit first;
    a tick takes ceil(width * height / 8) bytes. Without cameras the result is the streams and a stream.json, which
    `inspect` and `calibrate-rig` read. With cameras it is a scene whose cameras are all for training.

    Cameras come from a COLMAP model (its folder, text or binary), from OpenCV (a YAML or XML file with a map for each
    camera, or a folder of files, one for each), or from Kalibr (camchain.yaml). They are named like the .dat files.
    Lens distortion by OpenCV's k1, k2, p1, p2, k3 is kept (COLMAP's SIMPLE_RADIAL, RADIAL and OPENCV, Kalibr's radtan).
    Another lens, such as a fisheye, is refused where it distorts by 0.05 px or more.

    Args:
        path: A .dat file, or a folder of them; a camera is called like its file.
        width: Pixels per row.
        height: Rows.
        rate_hz: Ticks per second.
        out: New folder to write.
        cameras: COLMAP model folder, OpenCV file or folder, or Kalibr file. COLMAP's unit of length is any; a scene's
            is the metre.
        radiance_gain: Spikes per tick of a pixel at radiance 1 (white). With 1, radiance is in spikes per tick.
        rows_top_down: The files store the top row first. The usual order of this camera is bottom row first.
        licence: Licence of the recording.
    """
    if not (0 < rate_hz <= MAX_HZ and 0 < radiance_gain <= MAX_GAIN):
        found = f"{rate_hz:g}, {radiance_gain:g}"
        raise problem("--rate-hz and --radiance-gain", f"positive numbers, at most {MAX_HZ:g}", found, "correct it")
    if max(width, height) > MAX_SIDE:
        raise problem("--width and --height", f"at most {MAX_SIDE}", f"{width}, {height}", "correct it")
    files = {file.stem: file for file in _dat_files(path)}
    check_ids(files, "camera", path, "rename the .dat file, after which the camera is called")
    sources = {
        name: open_stream(file, width, height, rate_hz, rows_bottom_up=not rows_top_down)
        for name, file in files.items()
    }
    found_cameras = None if cameras is None else _cameras(cameras, sources, (width, height))
    check_new(out)
    streams = {}
    for name, source in sources.items():
        target = out / (f"{name}.dat" if found_cameras is None else stream_name(name))
        streams[name] = _copied(source, target)
        print(f"{target}: {source.n_ticks} ticks of {width}x{height}")
    if found_cameras is None:
        write_stream_folder(out, streams, {"source": {"kind": "dat"}})
        print(f"{out}: a folder of streams without poses")
    else:
        write_recorded_scene(out, found_cameras, streams, radiance_gain, licence, "dat")
        print(f"{out}: a scene of {len(streams)} training cameras")
    return 0


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
    """Copy a stream, and return the copy."""
    with SpikeWriter(target, source.width, source.height) as writer:
        for start in range(0, source.n_ticks, _TICKS):
            writer.write(source.packed[start : start + _TICKS])
    bottom_up = source.rows_bottom_up
    return open_stream(target, source.width, source.height, source.rate_hz, rows_bottom_up=bottom_up)
