"""The maintainers' folder of a season, which nobody else can read until the end:

opening.json            the seeds and the salt
scenes/ID/              the hidden scenes
training/ID/            their training parts
packs/ID.tar            the hidden scenes as tars; ID-training.tar: their training parts
runs/                   the fits of methods that the maintainers run, with predictions/METHOD/ID/
"""

from __future__ import annotations

from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.leaderboard.season.season_file import Season


def scene_folder(secret: Path, scene: str) -> Path:
    """Return the folder of a hidden scene."""
    return secret / "scenes" / scene


def training_folder(secret: Path, scene: str) -> Path:
    """Return the folder of a hidden scene's training part."""
    return secret / "training" / scene


def pack_file(secret: Path, scene: str, training: bool) -> Path:
    """Return the tar of a hidden scene, or of its training part."""
    return secret / "packs" / f"{scene}{'-training' if training else ''}.tar"


def runs_folder(secret: Path) -> Path:
    """Return the folder of the maintainers' own runs."""
    return secret / "runs"


def open_committed(secret: Path, season: Season, training: bool = False) -> list[Scene]:
    """Open the hidden scenes, or their training parts. Raises UserError where one is not as committed."""
    folder = training_folder if training else scene_folder
    expected = {s.id: s.training_revision if training else s.revision for s in season.scenes}
    scenes = [open_scene(folder(secret, scene)) for scene in expected]
    for scene in scenes:
        if scene.revision != expected[scene.id]:
            found, fix = f"{scene.revision[:16]}...", "restore the scene that `season make` made"
            raise problem(scene.root, f"revision {expected[scene.id][:16]}..., as committed", found, fix)
    return scenes
