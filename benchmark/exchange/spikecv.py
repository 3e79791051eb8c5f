"""SpikeCV folders: `config.yaml` beside one stream, one folder per camera. Import and export.

config.yaml knows `filename`, `spike_w`, `spike_h`, `is_labeled`, `labeled_data_type` and `labeled_data_suffix`, and
nothing of the frame rate, the order of rows, the camera, its pose or the time: an import asks for them.

Both formats are one bit per pixel, row-major, least significant bit first, so for H * W a multiple of 8 the bytes are
the same. Otherwise SpikeCV counts H * W bits to a tick without padding (tick t begins at bit t * H * W), while ours
begins every tick on a whole byte: then the bits are packed anew. Eight ticks are H * W bytes in SpikeCV at any size.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path, check_new, read_json, write_text
from spike4dgs.benchmark.scene.cameras import Camera, from_nerfstudio
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene, stream_name
from spike4dgs.benchmark.spikes.folder import write_stream_folder
from spike4dgs.benchmark.spikes.stream import SpikeStream, SpikeWriter, UInt8, open_stream
from spike4dgs.benchmark.untrusted.names import check_ids, inside
from spike4dgs.benchmark.untrusted.numbers import MAX_GAIN, MAX_HZ, MAX_SIDE, shown
from spike4dgs.benchmark.untrusted.yaml_file import read_yaml

CONFIG = "config.yaml"
_TICKS = 512  # packed anew at a time: a multiple of 8, so that every part but the last is whole bytes


@dataclass(frozen=True)
class _Source:
    """A stream in SpikeCV's layout: contiguous bits."""

    path: Path
    width: int
    height: int
    n_ticks: int


def import_spikecv(
    folder: Positional[Path],
    out: Path,
    rate_hz: float,
    transforms: Path | None = None,
    radiance_gain: float = 1.0,
    rows_top_down: bool = False,
    licence: str = "unknown",
) -> int:
    """Import a SpikeCV folder, or a folder of them (one per camera), as a scene folder or a folder of streams.

    With poses the result is a scene whose cameras are all for training and that has no scored images; without, it is
    the streams and a stream.json, which `inspect` reads. Labels are not imported. Streams whose H*W is no multiple of
    8 are packed anew, because ours begin every tick on a whole byte.

    spike4dgs import-spikecv motVidarReal2020/rotation1 --out data/rotation1 --rate-hz 20000

    Args:
        folder: Folder with config.yaml, or with one such folder per camera; the camera is called like its folder.
        out: New folder to write.
        rate_hz: Ticks per second, which SpikeCV does not record.
        transforms: nerfstudio file (JSON) with intrinsics and a pose for each camera, named by the key "camera".
        radiance_gain: Spikes per tick of a pixel at radiance 1 (white). With 1, radiance is in spikes per tick.
        rows_top_down: The file stores the top row first. The usual order of this camera is bottom row first.
        licence: Licence of the recording.
    """
    if not (0 < rate_hz <= MAX_HZ and 0 < radiance_gain <= MAX_GAIN):
        found = f"{rate_hz:g}, {radiance_gain:g}"
        raise problem("rate_hz and radiance_gain", f"positive numbers, at most {MAX_HZ:g}", found, "correct it")
    sources = {path.name: _read_config(path) for path in _spikecv_folders(folder)}
    check_ids(sources, "camera", folder, "rename the camera's folder")
    cameras = None if transforms is None else _read_poses(transforms, sources)
    check_new(out)
    streams = {}
    for camera, source in sources.items():
        target = out / (f"{camera}.dat" if cameras is None else stream_name(camera))
        with SpikeWriter(target, source.width, source.height) as writer:
            for packed in _read_ticks(source):
                writer.write(packed)
        size = (source.width, source.height)
        streams[camera] = open_stream(target, *size, rate_hz, rows_bottom_up=not rows_top_down)
        print(f"{target}: {source.n_ticks} ticks of {source.width}x{source.height}")
    if cameras is None:
        write_stream_folder(out, streams)
    else:
        write_recorded_scene(out, cameras, streams, radiance_gain, licence, "spikecv")
    return 0


def export_spikecv(scene: Positional[Path], out: Path, allow_gaps: bool = False) -> int:
    """Write the streams of a scene as SpikeCV folders, one per camera, rows bottom-up (SpikeCV's default).

    SpikeCV does not store the rate, the poses, the clock, the radiance gain, gaps and the scored images: they are left
    out. Streams whose H*W is no multiple of 8 are packed anew without padding, as SpikeCV counts bytes.

    spike4dgs export-spikecv data/car-0-small --out car-spikecv

    Args:
        scene: Scene folder.
        out: New folder; each camera becomes a folder in it.
        allow_gaps: Export a recording with gaps all the same.
    """
    opened = open_scene(scene, allow_gaps)
    check_new(out)
    for camera in opened.meta["streams"]:
        stream = opened.stream(camera)
        with atomic_path(out / camera / f"{camera}.dat") as part, open(part, "wb") as file:
            for start in range(0, stream.n_ticks, _TICKS):
                spikes = stream.window(start, min(start + _TICKS, stream.n_ticks))
                file.write(np.packbits(spikes[:, ::-1].reshape(-1), bitorder="little").data)
        write_text(out / camera / CONFIG, _config(camera, stream))
        print(f"{out / camera}: {stream.n_ticks} ticks of {stream.width}x{stream.height}")
    print(f"not in SpikeCV's format: {opened.rate_hz:g} ticks per second, poses, clock, gain, scored images")
    return 0


def _config(camera: str, stream: SpikeStream) -> str:
    import yaml

    config = {
        "filename": f"{camera}.dat",
        "spike_w": stream.width,
        "spike_h": stream.height,
        "is_labeled": False,
        "labeled_data_type": [],
        "labeled_data_suffix": "",
    }
    return str(yaml.safe_dump(config, sort_keys=False))


def _spikecv_folders(folder: Path) -> list[Path]:
    if (folder / CONFIG).is_file():
        return [folder.resolve()]
    found = sorted(path.parent for path in folder.glob(f"*/{CONFIG}"))
    if not found:
        raise problem(folder, f"a folder with {CONFIG}, or folders that have one", "none", "check the path")
    return found


def _read_config(folder: Path) -> _Source:
    """Read config.yaml of a SpikeCV folder. Raises UserError where it or the stream is missing or damaged."""
    path = folder / CONFIG
    keys = "filename, spike_w and spike_h"
    config = read_yaml(path, "a stream's description")
    try:
        name, width, height = config["filename"], config["spike_w"], config["spike_h"]
    except (KeyError, TypeError) as e:
        raise problem(path, keys, f"no {e}", "restore the file") from None
    if not isinstance(name, str) or any(type(side) is not int or not 0 < side <= MAX_SIDE for side in (width, height)):
        found = f"{shown(name)}, {shown(width)}, {shown(height)}"
        raise problem(path, f"{keys} of one stream", found, "correct the file")
    return _source(inside(folder, name, path), width, height)


def _source(path: Path, width: int, height: int) -> _Source:
    if not path.is_file():
        raise problem(path, f"the stream that {CONFIG} names", "no such file", "restore it")
    pixels, bits = width * height, 8 * path.stat().st_size
    n_ticks = bits // pixels
    if n_ticks == 0 or bits - n_ticks * pixels >= 8:
        found = f"{bits // 8} bytes, {bits / pixels:.3f} ticks"
        raise problem(path, f"whole ticks of {width}x{height} pixels", found, "it is truncated or of another size")
    return _Source(path, width, height, n_ticks)


def _read_ticks(source: _Source) -> Iterator[UInt8]:
    """Yield rows of our layout, at most _TICKS at a time."""
    pixels = source.width * source.height
    with open(source.path, "rb") as file:
        for start in range(0, source.n_ticks, _TICKS):
            n = min(_TICKS, source.n_ticks - start)
            data = np.frombuffer(file.read((n * pixels + 7) // 8), np.uint8)
            spikes = np.unpackbits(data, count=n * pixels, bitorder="little")
            yield np.packbits(spikes.reshape(n, pixels), axis=1, bitorder="little")


def _read_poses(path: Path, sources: dict[str, _Source]) -> tuple[Camera, ...]:
    """Read a camera for each stream; intrinsics are given at each frame or once at the top, as nerfstudio allows.

    Raises UserError where a stream has no pose, or the streams do not fit the poses or each other.
    """
    data = read_json(path, "camera poses")
    listed = data.get("frames", [])
    if not isinstance(listed, list) or not all(isinstance(frame, dict) for frame in listed):
        raise problem(path, "a list `frames` of objects", "another value", "correct the file")
    frames: list[dict[str, Any]] = [{**data, **frame} for frame in listed]
    cameras = {str(f.get("camera")): from_nerfstudio(str(f.get("camera")), f, str(path)) for f in frames}
    missing = sorted(set(sources) - set(cameras))
    if missing:
        found = f"none for {', '.join(missing)} (it has {', '.join(sorted(cameras)) or 'no frames'})"
        raise problem(path, 'a frame with "camera" for each folder', found, "rename the folders or add the frames")
    for name, source in sources.items():
        if (cameras[name].width, cameras[name].height) != (source.width, source.height):
            found = f"{cameras[name].width}x{cameras[name].height}"
            raise problem(path, f"{source.width}x{source.height} pixels for {name}", found, "correct w and h")
    shapes = sorted({(s.width, s.height, s.n_ticks) for s in sources.values()})
    if len(shapes) > 1:
        found = " and ".join(f"{w}x{h}x{n}" for w, h, n in shapes)
        raise problem(path, "streams of one size and length for one scene", found, "cut them to one length")
    return tuple(cameras[name] for name in sorted(sources))


def write_recorded_scene(
    out: Path,
    cameras: tuple[Camera, ...],
    streams: dict[str, SpikeStream],
    radiance_gain: float,
    licence: str,
    kind: str,
) -> None:
    """Describe streams of one length, which are already in `out`, as a scene without truth; all cameras train.

    `kind` is the source in scene.json.
    """
    first = streams[cameras[0].id]
    name = out.resolve().name
    finish_scene(
        out,
        SceneDescription(
            id=name,
            title=f"Recording {name}",
            licence=licence,
            cameras=cameras,
            train=tuple(c.id for c in cameras),
            test=(),
            rate_hz=first.rate_hz,
            n_ticks=first.n_ticks,
            radiance_gain=radiance_gain,
            targets=(),
            sensor={"model": "unknown", "rows_bottom_up": first.rows_bottom_up},
            source={"kind": kind},
            clock={"t0_ns": 0, "source": "unknown"},
            sync={"method": "unknown", "max_error_us": None},
        ),
    )
