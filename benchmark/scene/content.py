"""The content of a scene: what is fitted and scored, in a form that depends on no file's encoding.

The revision is the SHA-256 of a canonical JSON text: the clock, the cameras, the splits, the targets, the facts of the
calibration, and a hash of each data file's content. Outside are the scene's name and texts, its licence, previews, the
copies of its poses, geometry/, the frames and events of other sensors, and who made it with which versions.

Frames and events are outside because no track fits them, and because a value of theirs may fall to the other side of a
rounding or a threshold on another processor.

A stream's content is its bytes. That of an image or an .npz is its arrays, so another compression has the same hash;
a mask's is the region that is scored. That of a recording of light or darkness is its counts
(`spikes.counted_recording`).
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_json
from spike4dgs.benchmark.scene.images import read_channels, read_mask
from spike4dgs.benchmark.spikes.counted_recording import counted
from spike4dgs.benchmark.spikes.stream import open_stream
from spike4dgs.benchmark.untrusted import read_npz

FORMAT = "spike4dgs-content/1"
Arrays = dict[str, NDArray[Any]]
Meta = Mapping[str, Any]  # scene.json

_DATA = re.compile(  # a path below the scene folder; what comes before the suffix is the key of its content
    r"(images/[^/]+/\d+\.exr|masks/[^/]+/\d+\.png|truth/[^/]+\.npz"
    r"|calibration/(flat|dark)/[^/]+\.(dat|npz))"
)
_DECIMALS = 9  # of poses (a nanometre) and intrinsics: their last bits depend on the processor's linear algebra
_CALIBRATION = ("flat_radiance", "flat_ticks", "dark_ticks")


def is_encoded(name: str) -> bool:
    """Return whether a file is data whose content is not its bytes, by its path below the scene folder."""
    return _DATA.fullmatch(name) is not None


def data_files(names: Iterable[str], streams: Mapping[str, str]) -> dict[str, str]:
    """Return the files that are fitted or scored, by the key of their content, such as `images/cam_04/000120`.

    `streams`: camera -> path, as scene.json has it. Raises UserError where two files are the same recording.
    """
    found = {f"spikes/{camera}": path for camera, path in streams.items()}
    for name in filter(is_encoded, names):
        key = name.rpartition(".")[0]
        if key in found:
            raise problem(name, "one file of a recording, .dat or .npz", f"{found[key]} too", "remove one of them")
        found[key] = name
    return found


def hash_content(path: Path, name: str, meta: Meta) -> str:
    """Return the SHA-256 of the content of an encoded file; `name` is its path below the scene folder.

    Raises UserError where it is missing or damaged.
    """
    return hash_arrays(_decoded(path, name, meta))


def hash_arrays(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 of arrays in canonical form: by name, each its type, shape and values (little-endian, C)."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        values = arrays[name].astype(arrays[name].dtype.newbyteorder("<"))
        digest.update(json.dumps([name, values.dtype.str, list(values.shape)]).encode() + b"\n")
        digest.update(values.tobytes())
    return digest.hexdigest()


def _decoded(path: Path, name: str, meta: Meta) -> Arrays:
    suffix = Path(name).suffix
    if suffix == ".exr":
        return read_channels(path)
    if suffix == ".png":
        return {"mask": read_mask(path)}
    if suffix == ".npz":
        return read_npz(path, "the arrays of a scene")
    size, order = (int(meta["width"]), int(meta["height"])), bool(meta["sensor"]["rows_bottom_up"])
    return counted(open_stream(path, *size, float(meta["rate_hz"]), rows_bottom_up=order)).arrays


def revision_of(
    meta: Meta,
    cameras: Mapping[str, Mapping[str, Any]],
    targets: Mapping[str, Sequence[Any]],
    gaps: Sequence[Any],
    files: Mapping[str, str],
) -> str:
    """Return the revision of a scene.

    `meta` is scene.json; `cameras` the numbers that were read of each, `targets` [camera, tick] of each split, `gaps`
    [camera, first tick, ticks], `files` the hash of each file's content by its key.
    """
    calibration = meta.get("calibration", {})
    return sha256_json(
        {
            "format": FORMAT,
            "rate_hz": float(meta["rate_hz"]),
            "n_ticks": int(meta["n_ticks"]),
            "radiance_gain": float(meta["radiance_gain"]),
            "size": [int(meta["width"]), int(meta["height"])],
            "rows_bottom_up": bool(meta["sensor"]["rows_bottom_up"]),
            # Older scenes have no such key, and no dead ticks.
            **({"dead_ticks": float(dead)} if (dead := meta["sensor"].get("dead_ticks", 0)) else {}),
            "gaps": gaps,
            "cameras": _rounded(cameras),
            "splits": meta["splits"],
            "default_split": meta["default_split"],
            "targets": targets,
            "calibration": {k: calibration[k] for k in _CALIBRATION if k in calibration},
            "files": files,
        }
    )


def _rounded(value: Any) -> Any:
    """Return a JSON value with its numbers rounded to _DECIMALS, and no negative zero."""
    if isinstance(value, Mapping):
        return {key: _rounded(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    return round(value, _DECIMALS) + 0.0 if isinstance(value, float) else value
