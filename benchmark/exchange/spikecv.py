"""SpikeCV folders: `config.yaml` and the streams that it describes. Import and export.

config.yaml knows `filename`, `spike_w`, `spike_h`, `is_labeled`, `labeled_data_type` and `labeled_data_suffix`, and
nothing of the frame rate, the order of rows, the camera, its pose or the time: an import asks for them. SpikeCV's
loader uses the size and the labels alone. Its own datasets give `filename` the dataset's name, and keep their streams
in folders below; an export names the one stream of a camera.

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

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.exchange.foreign_camera import FoundCamera, check_same
from spike4dgs.benchmark.exchange.recording import Recording, Source, write_recording
from spike4dgs.benchmark.files import atomic_path, filling, read_json, write_text
from spike4dgs.benchmark.scene.cameras import Camera, from_nerfstudio
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.untrusted import MAX_SIDE, check_ids, inside, read_yaml, shown

CONFIG = "config.yaml"
_SUFFIX = ".dat"
_RAW = 0  # SpikeCV's number for the task `raw`; its loader refuses a task that is not listed, labels or none
_TICKS = 512  # packed anew at a time: a multiple of 8, so that every part but the last is whole bytes


@dataclass(frozen=True)
class _Source:
    """A stream in SpikeCV's layout: contiguous bits."""

    path: Path
    width: int
    height: int
    n_ticks: int


def import_spikecv(
    folder: Path, out: Path, recording: Recording, transforms: Path | None = None
) -> dict[str, SpikeStream]:
    """Import a SpikeCV folder, or a folder of them (one per camera), to a new folder; return its streams.

    With a nerfstudio file of poses it is a scene, else a folder of streams. Raises UserError before anything is written
    where a folder is damaged, or the poses do not fit.
    """
    recording.check("--transforms", transforms)
    sources = _find_sources(folder)
    check_ids(sources, "camera", folder, "rename the camera's folder")
    cameras = None if transforms is None else _read_poses(transforms, sources)
    read = {name: Source(s.width, s.height, s.n_ticks, _read_ticks(s)) for name, s in sources.items()}
    return write_recording(out, read, cameras, recording, "spikecv")


def export_spikecv(scene: Scene, out: Path) -> None:
    """Write the streams of a scene as SpikeCV folders OUT/CAMERA, rows bottom-up (SpikeCV's default)."""
    with filling(out):
        for camera in scene.meta["streams"]:
            stream = scene.stream(camera)
            with atomic_path(out / camera / f"{camera}.dat") as part, open(part, "wb") as file:
                for start in range(0, stream.n_ticks, _TICKS):
                    spikes = stream.window(start, min(start + _TICKS, stream.n_ticks))
                    file.write(np.packbits(spikes[:, ::-1].reshape(-1), bitorder="little").data)
            write_text(out / camera / CONFIG, _config(camera, stream))


def _config(camera: str, stream: SpikeStream) -> str:
    import yaml

    config = {
        "filename": f"{camera}.dat",
        "spike_w": stream.width,
        "spike_h": stream.height,
        "is_labeled": False,
        "labeled_data_type": [_RAW],
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


def _find_sources(folder: Path) -> dict[str, _Source]:
    """Return the streams of all SpikeCV folders by camera. Raises UserError where two have one name."""
    found: dict[str, _Source] = {}
    for camera, source in (pair for described in _spikecv_folders(folder) for pair in _read_folder(described)):
        if camera in found:
            two = f"{found[camera].path} and {source.path}"
            raise problem(folder, "streams of different names", two, "rename one: a camera is called like its stream")
        found[camera] = source
    return found


def _read_folder(folder: Path) -> Iterator[tuple[str, _Source]]:
    """Yield the streams that config.yaml describes, with their cameras: the one that it names, called like the folder.

    If that is a dataset's name and no file, each .dat file below, called like the file. Raises UserError where
    config.yaml or a stream is missing or damaged.
    """
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
    named = inside(folder, name, path)
    if named.is_file() or named.suffix == _SUFFIX:
        yield folder.name, _source(named, width, height)
        return
    below = [inside(folder, dat.relative_to(folder).as_posix(), path) for dat in sorted(folder.rglob(f"*{_SUFFIX}"))]
    if not below:
        raise problem(path, f"a stream called {shown(name)}, or {_SUFFIX} files below", "neither", "restore them")
    for dat in below:
        yield dat.stem, _source(dat, width, height)


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


_LENSES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")  # k1, k2, p1, p2, k3, or some of them


def _read_poses(path: Path, sources: dict[str, _Source]) -> tuple[Camera, ...]:
    """Read a camera for each stream; intrinsics are given at each frame or once at the top, as nerfstudio allows.

    Frames without a stream are left out. Raises UserError where a stream has no pose or several, or another size.
    """
    data = read_json(path, "camera poses")
    listed = data.get("frames", [])
    if not isinstance(listed, list) or not all(isinstance(frame, dict) for frame in listed):
        raise problem(path, "a list `frames` of objects", "another value", "correct the file")
    named = [(str(frame.get("camera")), {**data, **frame}) for frame in listed]
    if missing := sorted(set(sources) - {name for name, _ in named}):
        found = f"none for {', '.join(missing)} (it has {', '.join(sorted({n for n, _ in named})) or 'no frames'})"
        raise problem(path, 'a frame with "camera" for each folder', found, "rename the folders or add the frames")
    cameras: dict[str, Camera] = {}
    for i, (name, frame) in enumerate(named):
        if name in sources:
            made = _read_frame(name, frame, path)
            check_same(FoundCamera(cameras.setdefault(name, made)), FoundCamera(made), f"frame {i}", path)
    for name, source in sources.items():
        if (cameras[name].width, cameras[name].height) != (source.width, source.height):
            found = f"{cameras[name].width}x{cameras[name].height}"
            raise problem(path, f"{source.width}x{source.height} pixels for {name}", found, "correct w and h")
    return tuple(cameras[name] for name in sorted(sources))


def _read_frame(name: str, frame: dict[str, Any], path: Path) -> Camera:
    model, more = str(frame.get("camera_model", "OPENCV")), [k for k in ("k4", "k5", "k6") if frame.get(k)]
    if model not in _LENSES or more:
        fix = "calibrate with OpenCV's first five coefficients"
        raise problem(path, f"a camera_model of {', '.join(_LENSES)}", f"{model} {' '.join(more)}".strip(), fix)
    return from_nerfstudio(name, frame, str(path))
