"""Check that the files of a scene hold the contents that make its revision."""

from __future__ import annotations

from collections.abc import Iterator

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.content import data_files
from spike4dgs.benchmark.scene.scene import Scene


def verify_content(scene: Scene) -> Iterator[str]:
    """Check the files that a scene's revision covers, and yield one line for each that does not bear it out.

    A manifest states the hash of each file's content, which opening the scene believes. Here every file is read: it is
    there, has the bytes that the manifest lists, and decodes to the content that the revision was made of.
    """
    for name in data_files(scene.manifest.files, scene.meta["streams"]).values():
        try:
            scene.manifest.path(name)
        except UserError as e:
            yield str(e)
