"""`verify`: check every file of a scene folder against its manifest, and the contents that make its revision."""

from __future__ import annotations

import sys
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.scene.scene import open_scenes
from spike4dgs.benchmark.scene.verify import verify_content


def verify(scenes: Positional[tuple[Path, ...]]) -> int:
    """Check the size and SHA-256 of every file of scene folders, and that the scenes can be read.

    Data that is fitted or scored is decoded too, to check that its contents give the revision.

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
