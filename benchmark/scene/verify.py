"""`verify`: check every file of a scene folder against its manifest."""

from __future__ import annotations

import sys
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.scene.scene import open_scenes


def verify(scenes: Positional[tuple[Path, ...]]) -> int:
    """Check size and SHA-256 of every file of scene folders, and that the scenes can be read.

    Args:
        scenes: Scene folders.
    """
    problems = 0
    for scene in open_scenes(scenes, allow_gaps=True):
        for line in scene.manifest.problems():
            print(f"error: {line}", file=sys.stderr)
            problems += 1
        print(f"{scene.root}: {len(scene.manifest.files)} files, revision {scene.revision}")
    return 2 if problems else 0
