"""Download scenes of a release: whole ones as scene folders, a window of time as a folder of streams.

A scene folder without manifest.json is unfinished, so that file comes last. A run that is killed leaves whole files and
parts, and the next one goes on from there.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import locked, read_json, sha256_file, visible, write_json, writing
from spike4dgs.benchmark.release import index
from spike4dgs.benchmark.release.index import Member, Release, SceneEntry, Shard, parse_release, parse_shard
from spike4dgs.benchmark.release.selection import Selection
from spike4dgs.benchmark.release.source import ByteProgress, Source, find_source, size_text
from spike4dgs.benchmark.release.transfer import Wanted, transfer
from spike4dgs.benchmark.scene import manifest
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.spikes import folder
from spike4dgs.benchmark.spikes.gaps import Gap, read_gaps
from spike4dgs.benchmark.spikes.stream import bytes_per_tick, open_stream

WORKERS = 4
_STARTED = ".download.json"  # in a folder: which version of a scene, or which excerpt, is being fetched into it
_PENDING = ".manifest.json"  # manifest.json until all else is there


@dataclass(frozen=True)
class Report:
    """What a download did: the folders it filled, the bytes it fetched, in how many requests and seconds."""

    folders: tuple[Path, ...]
    fetched: int
    requests: int
    seconds: float

    @property
    def line(self) -> str:
        """The report in one line."""
        rate = f", {size_text(self.fetched / self.seconds)}/s" if self.fetched and self.seconds else ""
        return f"fetched {self.fetched} bytes in {self.requests} requests, {self.seconds:.1f} s{rate}; all verified"


def open_release(source: Source, sha256: str | None = None) -> Release:
    """Fetch release.json. Raises UserError where there is none, or one with another hash than `sha256` (if given)."""
    text, where = source.read_all(index.NAME), source.where(index.NAME)
    found = hashlib.sha256(text).hexdigest()
    if sha256 not in (None, found):
        raise problem(where, f"sha256 {sha256}", found, "another release lies there: check the address and --sha256")
    return parse_release(text, found, where)


def download(source: Source, release: Release, selection: Selection, out: Path, workers: int = WORKERS) -> Report:
    """Fetch what is asked for into `out`: OUT/SCENE, or OUT/SCENE-START-STOPms for a window of time.

    Files that are there and good are kept; damaged ones are mended. Raises UserError where the release lacks what is
    asked for, where another version of a scene is there, where the disk has no room, where the source keeps failing.
    """
    selection.check(release)
    scenes = selection.entries(release)
    window = "" if selection.window_ms is None else "-{:g}-{:g}ms".format(*selection.window_ms)
    folders = tuple(out / f"{scene.id}{window}" for scene in scenes)
    with locked(out / ".download.lock", out, "a folder that no other program downloads into"):
        total = sum(map(selection.bytes_of, scenes))
        _check_room(out, total - sum(map(_held_bytes, folders)))
        with ByteProgress("downloading", total) as progress:
            running = _Download(source, release, selection, workers, progress)
            for scene, root in zip(scenes, folders, strict=True):
                if selection.window_ms is None:
                    running.fetch_scene(scene, root)
                else:
                    running.fetch_window(scene, root)
    return Report(folders, progress.done - progress.skipped, source.requests, progress.seconds)


def _held_bytes(root: Path) -> int:
    """Return the room that files below a folder take; of a part with holes, without them."""
    stats = [path.stat() for path in root.rglob("*") if path.is_file()]
    return sum(s.st_blocks * 512 if hasattr(s, "st_blocks") else s.st_size for s in stats)  # Windows has no blocks


def _check_room(out: Path, needed: int) -> None:
    free = shutil.disk_usage(out).free
    if needed > free:
        fix = "free some, choose another --out, or ask for fewer --scenes, --cameras or --parts"
        raise problem(out, f"{size_text(needed)} of free disk space", size_text(free), fix)


def _claim(root: Path, version: str) -> None:
    """Make a scene folder for the version with that manifest. Raises UserError where something else is in it."""
    finished, started = root / manifest.NAME, root / _STARTED
    held: str | None
    if finished.is_file():
        held = sha256_file(finished)
    elif started.is_file():
        held = read_json(started, "the record of a download").get("manifest_sha256")
    else:
        held = None if root.exists() and any(root.iterdir()) else version
    if held != version:
        raise problem(root, "this version of the scene, or no folder", "something else", "choose another --out")
    if not finished.is_file():
        write_json(started, {"manifest_sha256": version})


@dataclass
class _Download:
    """A download that runs, and the list of the shard that it read last."""

    source: Source
    release: Release
    selection: Selection
    workers: int
    progress: ByteProgress
    read: tuple[int, tuple[Member, ...]] = (-1, ())

    def fetch_scene(self, scene: SceneEntry, root: Path) -> None:
        """Fetch files of a scene, and its manifest last."""
        found = list(self._members(scene))
        own = next((member for _, member in found if member.path == manifest.NAME), None)
        if own is None:
            fix = "the release was packed wrongly: tell its owner"
            raise problem(self.source.address, f"{manifest.NAME} of {scene.id}", "none", fix)
        _claim(root, own.sha256)
        finished = root / manifest.NAME
        pending = finished if finished.exists() else root / _PENDING
        wanted = [Wanted(shard, m, pending if m is own else root / m.path) for shard, m in found]
        transfer(self.source, wanted, self.progress, self.workers)
        with writing(finished):
            os.replace(pending, finished)
            (root / _STARTED).unlink(missing_ok=True)
        listed = manifest.read_manifest(root)
        for _, m in found:
            if m is not own and m.path in listed.files and listed.files[m.path][1] != m.sha256:
                fix = "the release was packed wrongly: tell its owner"
                raise problem(root / m.path, f"the file of {manifest.NAME}", "another one", fix)
        for name in listed.recorded:
            if (root / name).is_file():  # some are not asked for
                listed.path(name)
        if self.selection.is_whole and (revision := open_scene(root, allow_gaps=True).revision) != scene.revision:
            fix = "the release was packed wrongly: tell its owner"
            raise problem(root, f"revision {scene.revision}", revision, fix)

    def fetch_window(self, scene: SceneEntry, root: Path) -> None:
        """Fetch some ticks of a scene's streams as a folder of streams, whose description comes last."""
        ticks, tick_bytes = self.selection.ticks(scene), bytes_per_tick(scene.width, scene.height)
        excerpt = {
            "release": self.release.name,
            "scene": scene.id,
            "revision": scene.revision,
            "first_tick": ticks.start,
            "n_ticks": len(ticks),
        }
        cut = (ticks.start * tick_bytes, ticks.stop * tick_bytes)
        wanted = [Wanted(shard, m, root / f"{m.camera}.dat", cut) for shard, m in self._members(scene)]
        started, hashes = root / _STARTED, dict[str, str]()
        if (root / folder.NAME).is_file():
            described = read_json(root / folder.NAME, "a description of streams")
            if described.get("excerpt") != excerpt:
                raise problem(root, "this window of the scene, or no folder", "something else", "choose another --out")
            hashes = described.get("sha256", {})
        elif not (started.is_file() and read_json(started, "the record of a download").get("excerpt") == excerpt):
            for w in wanted:  # of another window or by another program: nothing says of which ticks
                w.path.unlink(missing_ok=True)
            write_json(started, {"excerpt": excerpt})
        whole = [w for w in wanted if _is_window(w.path, cut[1] - cut[0], hashes)]
        fetched = {w.path.stem for w in wanted if w not in whole}
        known = {camera: sha256 for camera, sha256 in hashes.items() if camera not in fetched}
        for w in whole:
            w.part.unlink(missing_ok=True)
        transfer(self.source, [w for w in wanted if w not in whole], self.progress, self.workers)
        streams = {}
        for path in visible(root, "*.dat"):
            size, order, gaps = (scene.width, scene.height), scene.rows_bottom_up, _gaps_in(scene, path.stem, ticks)
            n_ticks, dead = len(ticks), scene.dead_ticks
            streams[path.stem] = open_stream(
                path, *size, scene.rate_hz, rows_bottom_up=order, n_ticks=n_ticks, gaps=gaps, dead_ticks=dead
            )
        hashes = {camera: known.get(camera) or sha256_file(root / f"{camera}.dat") for camera in streams}
        folder.write_stream_folder(root, streams, {"excerpt": excerpt, "sha256": hashes})
        started.unlink(missing_ok=True)

    def _members(self, scene: SceneEntry) -> Iterator[tuple[Shard, Member]]:
        """Yield the files that are asked of a scene, from the lists of those shards that hold some."""
        for number in sorted({sample.shard for sample in self.selection.samples(scene)}):
            shard = self.release.shards[number]
            if self.read[0] != number:
                text, where = self.source.read_all(shard.index), self.source.where(shard.index)
                if (found := hashlib.sha256(text).hexdigest()) != shard.index_sha256:
                    fix = "the server's copy is damaged, or of another release"
                    raise problem(where, f"sha256 {shard.index_sha256[:16]}...", f"{found[:16]}...", fix)
                self.read = (number, parse_shard(text, shard, where))
            for member in self.selection.members(self.read[1], scene):
                yield shard, member


def _is_window(path: Path, size: int, hashes: Mapping[str, str]) -> bool:
    """Return whether a window's stream is there and whole; and undamaged, where its hash is known."""
    if not path.is_file() or path.stat().st_size != size:
        return False
    return path.stem not in hashes or sha256_file(path) == hashes[path.stem]


def _gaps_in(scene: SceneEntry, camera: str, ticks: range) -> tuple[Gap, ...]:
    """Return a camera's gaps inside a window, counted from its first tick."""
    n_ticks = dict.fromkeys(scene.streams, scene.n_ticks)
    found = []
    for gap in read_gaps(scene.gaps, n_ticks, Path(scene.id)):
        start, stop = max(gap.first_tick, ticks.start), min(gap.stop_tick, ticks.stop)
        if gap.camera == camera and start < stop:
            found.append(Gap(camera, start - ticks.start, stop - start, gap.reason))
    return tuple(found)


def check_revisions(source: Source, release: Release, revisions: Mapping[str, str]) -> None:
    """Raise UserError where a release lacks one of these scenes, or has another revision of it."""
    for scene, revision in revisions.items():
        found = release.scenes[scene].revision if scene in release.scenes else "no such scene"
        if found != revision:
            raise problem(source.address, f"{scene} in revision {revision}", found, "name another release")


def track_folders(
    revisions: Mapping[str, str],
    data: Path,
    address: str | None,
    is_equivalent: Callable[[Scene], bool],
    made: str = "make-dataset",
) -> tuple[Path, ...]:
    """Return the folders DATA/SCENE of a track's scenes (id -> revision); what is missing is downloaded first.

    `made` is the command that makes them, for the error where there is no address.
    Raises UserError where a scene of another revision is there that is not equivalent, and where none can be
    downloaded.
    """
    missing = {}
    for scene, revision in revisions.items():
        root = data / scene
        if not (root / manifest.NAME).is_file():
            missing[scene] = revision
            continue
        opened = open_scene(root, allow_gaps=True)
        if opened.revision != revision and not is_equivalent(opened):
            fix = "choose another --data, or remove the folder, and the track's scene is downloaded"
            raise problem(root, f"revision {revision} of the track", opened.revision, fix)
        if not all((root / path).is_file() for path in opened.manifest.files):  # of a download of some parts
            missing[scene] = revision
    if missing:
        source = find_source(address, f"a release with {', '.join(missing)}", made)
        release = open_release(source)
        check_revisions(source, release, missing)
        print(f"{data}: downloading {', '.join(missing)} from {source.address}")
        print(download(source, release, Selection(scenes=tuple(missing)), data).line)
    return tuple(data / scene for scene in revisions)
