"""Pack scenes into a release: shards, their lists, release.json, a dataset card, Croissant and SHA256SUMS.

The same scenes give the same bytes. A killed run resumes: shards that are finished stay.
"""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path

from spike4dgs.benchmark import croissant
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import (
    check_new,
    locked,
    read_json,
    remove_parts,
    sha256_file,
    write_bytes,
    write_json,
    write_text,
    writing,
)
from spike4dgs.benchmark.release import card, index
from spike4dgs.benchmark.release.index import (
    Release,
    Sample,
    SceneEntry,
    Shard,
    camera_of,
    index_of,
    member_name,
    order_of,
    part_of,
    read_release,
    release_json,
)
from spike4dgs.benchmark.release.shard import PlannedFile, find_shard, write_shard
from spike4dgs.benchmark.release.source import ByteProgress
from spike4dgs.benchmark.scene import manifest
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.spikes.counted_recording import encode_recording

SUMS = "SHA256SUMS"
_SHARDS_PER_FOLDER = 1000  # two files each: well below what hosts allow in a folder


@dataclass(frozen=True)
class _PlannedSample:
    """The files of one camera of a scene, or with camera None those of the scene itself; they share a shard."""

    scene: Scene
    camera: str | None
    files: tuple[PlannedFile, ...]

    @cached_property
    def packed_bytes(self) -> int:
        return sum(file.packed_bytes for file in self.files)


def pack(scenes: Sequence[Scene], out: Path, name: str, shard_bytes: int, flat: bool = False) -> Release:
    """Write a release of scenes into the folder `out` and return it; with `flat` all files lie in `out` itself.

    A shard is as long as `shard_bytes`, or shorter; a camera that is longer has a shard of its own. Raises UserError
    where two scenes have one id, where a file is not what its manifest says, and where `out` holds another release.
    """
    if twice := [s.id for i, s in enumerate(scenes) if s.id in [other.id for other in scenes[:i]]]:
        raise problem(scenes[0].root, "scenes of different ids", f"{twice[0]} twice", "name each scene once")
    out = out.absolute()  # `.` has no name
    copies = out.with_name(f".{out.name}.counted")  # of scenes, while they are packed
    with locked(out.with_name(f".{out.name}.lock"), out, "a folder that no other program packs into"):
        scenes = [_with_counts(scene, copies / scene.id) for scene in scenes]
        samples = [sample for scene in scenes for sample in _samples(scene)]
        shards = list(_in_shards(samples, shard_bytes))
        folders = ["" if flat else f"shards/{i // _SHARDS_PER_FOLDER:03d}/" for i in range(len(shards))]
        names = [f"{folder}{index.SHARD}{name}-{i:05d}.tar" for i, folder in enumerate(folders)]
        _refuse_others(out, [*names, *map(index_of, names)])
        remove_parts(out)
        total = sum(file.bytes for sample in samples for file in sample.files)
        written = []
        with ByteProgress("packing", total) as progress:
            for shard_name, held in zip(names, shards, strict=True):
                files = [file for sample in held for file in sample.files]
                if shard := find_shard(out, shard_name, files):
                    progress.skip(sum(file.bytes for file in files))
                written.append(shard or write_shard(out, shard_name, files, progress.advance))
        _write_descriptions(out, name, scenes, shards, written)
        shutil.rmtree(copies, ignore_errors=True)
    return read_release(out)


def _with_counts(scene: Scene, copy: Path) -> Scene:
    """Return the scene, or a copy in which counts take the place of its recordings under uniform light and in the dark.

    They give the same calibration, and the scene the same revision, in a small part of the bytes.
    """
    if not any(re.fullmatch(r"calibration/(flat|dark)/[^/]+\.dat", path) for path in scene.manifest.files):
        return scene
    if copy.exists():  # an earlier run made it
        opened, kept = open_scene(copy, allow_gaps=True), dict(scene.manifest.files)
        texts = [name for name in kept if "/" not in name and name != croissant.NAME]  # a revision has no title
        if opened.revision == scene.revision and all(opened.manifest.files.get(name) == kept[name] for name in texts):
            return opened
        shutil.rmtree(copy)
    print(f"{scene.root}: counting the recordings of its sensors")
    return counted_copy(scene, copy)


def _samples(scene: Scene) -> Iterator[_PlannedSample]:
    """Yield the samples of a scene in their order. Raises UserError where two files would have one name."""
    files = dict(scene.manifest.files)
    own = scene.root / manifest.NAME
    files[manifest.NAME] = (own.stat().st_size, sha256_file(own))
    cameras = scene.meta["streams"]
    of_files = {path: camera_of(path, cameras) for path in files}
    ordered = sorted(files, key=lambda path: order_of(path, of_files[path]))
    planned = [
        PlannedFile(member_name(scene.id, p, of_files[p]), scene.id, p, of_files[p], scene.root / p, *files[p])
        for p in ordered
    ]
    names = [file.name for file in planned]
    if len(set(names)) < len(names):
        raise problem(scene.root, "paths that differ without their slashes", "two alike", "rename one of the files")
    for camera, held in groupby(planned, lambda file: file.camera):
        yield _PlannedSample(scene, camera, tuple(held))


def _in_shards(samples: Iterable[_PlannedSample], shard_bytes: int) -> Iterator[list[_PlannedSample]]:
    """Yield the samples of each shard: neighbours, as many as fit."""
    held: list[_PlannedSample] = []
    size = 0
    for sample in samples:
        if held and size + sample.packed_bytes > shard_bytes:
            yield held
            held, size = [], 0
        held.append(sample)
        size += sample.packed_bytes
    if held:
        yield held


def _refuse_others(out: Path, shards: Sequence[str]) -> None:
    """Raise UserError where `out` holds files that this release has not, such as those of another one."""
    ours = {*shards, index.NAME, SUMS, *card.NAMES}
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out).as_posix()
        if path.is_file() and name not in ours and not any(p.startswith(".") for p in name.split("/")):
            raise problem(out, "a new folder, or one of this release", name, "choose another --out or remove it")


def _write_descriptions(
    out: Path, name: str, scenes: Sequence[Scene], shards: Sequence[Sequence[_PlannedSample]], written: list[Shard]
) -> None:
    """Write release.json, the card and Croissant around the shards, and last of all the sums."""
    of_scene: dict[str, list[Sample]] = {scene.id: [] for scene in scenes}
    for number, held in enumerate(shards):
        for sample in held:
            sizes = Counter[str]()
            for file in sample.files:
                sizes[part_of(file.path)] += file.bytes
            of_scene[sample.scene.id].append(Sample(sample.camera, number, dict(sizes)))
    entries = [_entry(scene, tuple(of_scene[scene.id])) for scene in scenes]
    write_json(out / index.NAME, release_json(name, entries, written))
    card.write_card(out, name, entries, written)
    names = [*card.NAMES, index.NAME, *(name for s in written for name in (s.file, s.index))]
    known = {s.file: s.sha256 for s in written} | {s.index: s.index_sha256 for s in written}
    write_text(out / SUMS, "".join(f"{known.get(n) or sha256_file(out / n)}  {n}\n" for n in sorted(names)))


def _entry(scene: Scene, samples: tuple[Sample, ...]) -> SceneEntry:
    return SceneEntry(
        id=scene.id,
        revision=scene.revision,
        samples=samples,
        title=str(scene.meta["title"]),
        licence=str(scene.meta["licence"]),
        rate_hz=scene.rate_hz,
        n_ticks=scene.n_ticks,
        width=int(scene.meta["width"]),
        height=int(scene.meta["height"]),
        rows_bottom_up=bool(scene.meta["sensor"]["rows_bottom_up"]),
        streams=dict(scene.meta["streams"]),
        gaps=tuple(gap.record for gap in scene.gaps),
        dead_ticks=float(scene.meta["sensor"].get("dead_ticks", 0)),
    )


def counted_copy(scene: Scene, out: Path) -> Scene:
    """Write the scene to the new folder `out`, its recordings counted, and return the copy, which has its revision.

    Raises UserError where `out` is not new, and where a file is missing or damaged.
    """
    check_new(out)
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    try:
        for name in scene.manifest.files:
            if not name.startswith(("calibration/flat/", "calibration/dark/")):
                _copy(scene.manifest.path(name), part / name)
        for camera in scene.cameras:
            if found := scene.recordings(camera):
                for kind, recording in (("flat", found.flat), ("dark", found.dark)):
                    write_bytes(part / f"calibration/{kind}/{camera}.npz", encode_recording(recording))
        if (part / croissant.NAME).is_file():
            about = read_json(part / croissant.NAME, "a scene's description")["description"]
            croissant.write_croissant(part, scene.meta, str(about))
        write_manifest(part)
        if (found_revision := open_scene(part, allow_gaps=True).revision) != scene.revision:
            fix = "check it with `spike4dgs verify`"
            raise problem(scene.root, f"revision {scene.revision[:16]}...", f"{found_revision[:16]}...", fix)
        with writing(out):
            os.replace(part, out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return open_scene(out, allow_gaps=True, split=scene.split)


def _copy(source: Path, target: Path) -> None:
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
