"""Check that the files of a scene hold the contents that make its revision."""

from __future__ import annotations

from collections.abc import Iterator

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.scene.content import data_files, hash_content, is_encoded
from spike4dgs.benchmark.scene.scene import Scene


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
