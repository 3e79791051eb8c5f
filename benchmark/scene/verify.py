"""`verify`: check every file of a scene folder against its manifest, and the contents that make its revision."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.scene.content import data_files, hash_content, is_encoded
from spike4dgs.benchmark.scene.scene import Scene, open_scenes


def verify_content(scene: Scene) -> Iterator[str]:
    """Check the files that a scene's revision covers, and yield one line for each that does not bear it out.

    A manifest states the hash of each file's content, which opening the scene believes. Here every file is read: it is
    there, has the bytes that the manifest lists, and decodes to the content that the revision was made of.
    """
    for name in data_files(scene.manifest.files, scene.meta["streams"]).values():
        try:
            path = scene.manifest.path(name)
            if is_encoded(name) and (recorded := scene.manifest.recorded.get(name)):
                found = hash_content(path, name, scene.meta)
                if found != recorded:
                    fix = "the manifest claims another content: restore the scene or make it again"
                    raise problem(path, f"content {recorded[:16]}...", f"{found[:16]}...", fix)
        except UserError as e:
            yield str(e)


def verify(scenes: Positional[tuple[Path, ...]]) -> int:
    """Check size and SHA-256 of every file of scene folders, and that the scenes can be read.

    Data that is fitted or scored is decoded too: the revision is that of what the files hold.

    Args:
        scenes: Scene folders.
    """
    problems = 0
    for scene in open_scenes(scenes, allow_gaps=True):
        for line in dict.fromkeys([*scene.manifest.problems(), *verify_content(scene)]):
            print(f"error: {line}", file=sys.stderr)
            problems += 1
        print(f"{scene.root}: {len(scene.manifest.files)} files, revision {scene.revision}")
    return 2 if problems else 0
