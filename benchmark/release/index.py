"""The index of a release: release.json, and beside each shard the list of its members.

    release.json                        scenes: revision, size, clock, samples; shards: bytes, SHA-256, that of the list
    shards/000/spike4dgs-1-00000.tar    members, uncompressed
    shards/000/spike4dgs-1-00000.json   the list: member, scene, path, camera, part, offset, bytes, SHA-256 of it and of
                                        its blocks

The SHA-256 of release.json pins all of it. A client reads release.json and the lists of those shards alone that hold
what it wants, so a release of many terabytes costs its clients no more than they take.

A release is a WebDataset: the members of a shard whose names agree up to the first dot of the base name are one sample.
Here a sample is one camera of a scene, with all that belongs to it, or the scene's own files:

    car-0-small/scene.scene.json                  car-0-small: scene.json
    car-0-small/cam_00.spikes.dat                 car-0-small: spikes/cam_00.dat
    car-0-small/cam_00.images.000120.exr          car-0-small: images/cam_00/000120.exr

Names that unpack with `tar xf` into a scene folder would make a sample of every single file. So the list states the
path of each member, and `spike4dgs download --from FOLDER` unpacks.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.json_values.text import parse_json
from spike4dgs.benchmark.schemas import check_schema, load_schema

NAME = "release.json"
SHARD = "spike4dgs-"  # begins the name of a shard and of its list
SCHEMA, SHARD_SCHEMA = "spike4dgs-packed-release/1", "spike4dgs-shard/1"
BLOCK = 1 << 20  # bytes that have a hash of their own: the smallest piece of a file that can be checked
_FIX = "fetch the release again, or pack it again"


@dataclass(frozen=True)
class Member:
    """A file of a scene in a shard. `blocks` has the SHA-256 of each BLOCK bytes of it; the last may be shorter."""

    name: str
    scene: str
    path: str  # in the scene folder
    camera: str | None
    offset: int  # of its first byte in the shard
    bytes: int
    sha256: str
    blocks: tuple[str, ...]


def index_of(shard: str) -> str:
    """Return the path of the list of a shard's members, in the release."""
    return shard.removesuffix(".tar") + ".json"


@dataclass(frozen=True)
class Shard:
    """A tar of a release: its path in the release, and its list of members as a file."""

    file: str
    bytes: int
    sha256: str
    index_bytes: int
    index_sha256: str

    @property
    def index(self) -> str:
        """The path of its list of members in the release."""
        return index_of(self.file)


@dataclass(frozen=True)
class Sample:
    """One camera of a scene, or with camera None the scene's own files: its shard, and bytes by part."""

    camera: str | None
    shard: int
    sizes: dict[str, int]


@dataclass(frozen=True)
class SceneEntry:
    """A scene of a release. The fields after `licence` are those of scene.json."""

    id: str
    revision: str
    samples: tuple[Sample, ...]
    title: str
    licence: str
    rate_hz: float
    n_ticks: int
    width: int
    height: int
    rows_bottom_up: bool
    streams: dict[str, str]  # camera -> path
    gaps: tuple[dict[str, Any], ...]
    dead_ticks: float = 0.0

    @property
    def bytes(self) -> int:
        """The size of all its files."""
        return sum(sum(sample.sizes.values()) for sample in self.samples)

    @property
    def parts(self) -> dict[str, int]:
        """Bytes by part."""
        sizes: Counter[str] = Counter()
        for sample in self.samples:
            sizes.update(sample.sizes)
        return dict(sizes)


@dataclass(frozen=True)
class Release:
    """What release.json says. `sha256` is that of the file itself."""

    name: str
    scenes: dict[str, SceneEntry]
    shards: tuple[Shard, ...]
    sha256: str


def release_json(name: str, scenes: list[SceneEntry], shards: list[Shard]) -> dict[str, Any]:
    """Return the content of release.json."""
    return {
        "schema": SCHEMA,
        "name": name,
        "block_bytes": BLOCK,
        "scenes": list(map(_facts, scenes)),
        "shards": list(map(asdict, shards)),
    }


def _facts(scene: SceneEntry) -> dict[str, Any]:
    facts = {**asdict(scene), "bytes": scene.bytes}
    return {name: value for name, value in facts.items() if name != "dead_ticks" or value}


def parse_release(text: bytes, sha256: str, where: str) -> Release:
    """Return the release that a release.json describes. Raises UserError where it is damaged or foreign."""
    data = _parse(text, where, SCHEMA, "release.schema.json")
    scenes = {s["id"]: _scene(s) for s in data["scenes"]}
    shards = tuple(Shard(**s) for s in data["shards"])
    used = {sample.shard for scene in scenes.values() for sample in scene.samples}
    if len(scenes) != len(data["scenes"]) or not used <= set(range(len(shards))):
        raise problem(where, "distinct scenes in the shards that it lists", "others", _FIX)
    return Release(data["name"], scenes, shards, sha256)


def _scene(data: dict[str, Any]) -> SceneEntry:
    samples = tuple(Sample(**s) for s in data["samples"])
    facts = {k: v for k, v in data.items() if k != "bytes"}
    return SceneEntry(**facts | {"samples": samples, "gaps": tuple(data["gaps"])})


def shard_json(file: str, size: int, sha256: str, members: list[Member]) -> dict[str, Any]:
    """Return the content of the list of a shard's members."""
    return {
        "schema": SHARD_SCHEMA,
        "shard": file,
        "bytes": size,
        "sha256": sha256,
        "files": [{**asdict(m), "part": part_of(m.path)} for m in members],
    }


def parse_shard(text: bytes, shard: Shard, where: str) -> tuple[Member, ...]:
    """Return the members of a shard. Raises UserError where the list is damaged, or none of this shard."""
    data = _parse(text, where, SHARD_SCHEMA, "shard.schema.json")
    fields = ("name", "scene", "path", "camera", "offset", "bytes", "sha256")
    members = tuple(Member(**{k: f[k] for k in fields}, blocks=tuple(f["blocks"])) for f in data["files"])
    for m in members:
        if m.offset + m.bytes > shard.bytes or len(m.blocks) != max(-(-m.bytes // BLOCK), 1):
            raise problem(where, f"files inside {shard.bytes} bytes, with a hash a block", m.name, _FIX)
    if len({(m.scene, m.path) for m in members}) < len(members):
        raise problem(where, "distinct files", "one twice", _FIX)
    if (data["shard"], data["bytes"], data["sha256"]) != (shard.file, shard.bytes, shard.sha256):
        raise problem(where, f"the members of {shard.file}", "those of another file", _FIX)
    return members


def _parse(text: bytes, where: str, schema: str, file: str) -> dict[str, Any]:
    try:
        data = parse_json(text.decode())
    except ValueError as e:
        raise problem(where, f"a {schema} (JSON)", f"damaged text ({e})", _FIX) from None
    found = data.get("schema") if isinstance(data, dict) else type(data).__name__
    if found != schema:
        raise problem(where, f"schema {schema}", repr(found), "name the folder of a release of this version")
    check_schema(data, load_schema("spike4dgs.benchmark.release", file), where, _FIX)
    checked: dict[str, Any] = data
    return checked


def read_release(root: Path) -> Release:
    """Read release.json of a folder. Raises UserError where it is missing or damaged."""
    path = root / NAME
    if not path.is_file():
        raise problem(path, "the description of a release", "no such file", "name a folder of `spike4dgs release pack`")
    text = path.read_bytes()
    return parse_release(text, hashlib.sha256(text).hexdigest(), str(path))


DESCRIPTION = "description"  # the part of the files at the top of a scene folder
SCENE_SAMPLE = "scene"  # the sample of what belongs to no camera
# What comes first of a camera; other parts follow by name.
_ORDER = ("spikes", "calibration", "truth", "images", "masks", "geometry", "events", "conventional")


def part_of(path: str) -> str:
    """Return the part that a file belongs to: the folder at the top of its path, such as `spikes`, or DESCRIPTION."""
    top, _, rest = path.partition("/")
    return top if rest else DESCRIPTION


def camera_of(path: str, cameras: Collection[str]) -> str | None:
    """Return the camera that a file belongs to, by the names of its folders and its own; None for the scene's files.

    The folder at the top names a part, and those of COLMAP's model and of the recordings no camera, such as `0`.
    """
    top, _, rest = path.partition("/")
    if not rest or top == "sparse":
        return None
    *folders, name = rest.split("/")
    named = [word for word in folders if word in cameras and top != "calibration"]
    named = named or sorted((c for c in cameras if name.startswith(f"{c}.")), key=len)[-1:]  # `cam` begins `cam.1` too
    return named[0] if named else None


def member_name(scene: str, path: str, camera: str | None) -> str:
    """Return the name of a file in its shard: SCENE/SAMPLE.REST, the rest being the path with dots for slashes."""
    words = path.split("/")
    if camera is not None:
        words[-1] = words[-1].removeprefix(f"{camera}.")
        words = [words[0], *(word for word in words[1:] if word != camera)]
    return f"{scene}/{SCENE_SAMPLE if camera is None else camera}.{'.'.join(words)}"


def order_of(path: str, camera: str | None) -> tuple[str, int, str]:
    """Return a file's place in its scene: the scene's own files first, then camera by camera."""
    part = part_of(path)
    rank = -1 if part == DESCRIPTION else _ORDER.index(part) if part in _ORDER else len(_ORDER)
    return camera or "", rank, path
