"""The maintainers' folder of a season, which nobody else can read until the end:

opening.json            the seeds and the salt
scenes/ID/              the hidden scenes
training/ID/            their training parts
packs/ID.tar            the hidden scenes as tars; ID-training.tar: their training parts
runs/                   the fits of methods that the maintainers run, with predictions/METHOD/ID/
"""

from __future__ import annotations

import io
import tarfile
from pathlib import Path
from typing import IO

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path, sha256_file
from spike4dgs.benchmark.scene.manifest import NAME
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


def pack_scene(scene: Scene, path: Path) -> str:
    """Write the files of a scene's manifest, and the manifest, as a tar that unpacks to SCENE/; return its SHA-256.

    Members are sorted by name and have no owner and no time. Raises UserError where a file is not as recorded.
    """
    with atomic_path(path) as part, tarfile.open(part, "w", format=tarfile.USTAR_FORMAT) as tar:
        for name in sorted([*scene.manifest.files, NAME]):
            source = scene.root / name if name == NAME else scene.manifest.path(name)
            with open(source, "rb") as file:
                tar.addfile(_member(f"{scene.id}/{name}", file), file)
    return sha256_file(path)


def _member(name: str, file: IO[bytes]) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)  # no owner, and the time 0
    info.size, info.mode = file.seek(0, io.SEEK_END), 0o644
    file.seek(0)
    return info
