"""The scenes of a track: those that are on this machine in the right revision, and the others from a release."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.release.index import Release
from spike4dgs.benchmark.release.scenes import download, open_release
from spike4dgs.benchmark.release.selection import Selection
from spike4dgs.benchmark.release.source import Source, find_source
from spike4dgs.benchmark.scene import manifest
from spike4dgs.benchmark.scene.scene import open_scene


def check_revisions(source: Source, release: Release, revisions: Mapping[str, str]) -> None:
    """Raise UserError where a release lacks one of these scenes, or has another revision of it."""
    for scene, revision in revisions.items():
        found = release.scenes[scene].revision if scene in release.scenes else "no such scene"
        if found != revision:
            raise problem(source.address, f"{scene} in revision {revision}", found, "name another release")


def track_folders(revisions: Mapping[str, str], data: Path, address: str | None) -> tuple[Path, ...]:
    """Return the folders DATA/SCENE of a track's scenes (id -> revision); what is missing is downloaded first.

    Raises UserError where another revision of a scene is there, and where none can be downloaded.
    """
    missing = {}
    for scene, revision in revisions.items():
        root = data / scene
        if not (root / manifest.NAME).is_file():
            missing[scene] = revision
            continue
        opened = open_scene(root, allow_gaps=True)
        if opened.revision != revision:
            fix = "choose another --data, or remove the folder, and the track's scene is downloaded"
            raise problem(root, f"revision {revision} of the track", opened.revision, fix)
        if not all((root / path).is_file() for path in opened.manifest.files):  # of a download of some parts
            missing[scene] = revision
    if missing:
        source = find_source(address, f"a release with {', '.join(missing)}")
        release = open_release(source)
        check_revisions(source, release, missing)
        print(f"{data}: downloading {', '.join(missing)} from {source.address}")
        print(download(source, release, Selection(scenes=tuple(missing)), data).line)
    return tuple(data / scene for scene in revisions)
