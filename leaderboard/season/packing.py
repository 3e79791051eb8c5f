"""A scene folder as one tar: the same bytes for the same files, so that its SHA-256 commits to all of them."""

from __future__ import annotations

import io
import tarfile
from pathlib import Path
from typing import IO

from spike4dgs.benchmark.files import atomic_path, sha256_file
from spike4dgs.benchmark.scene.manifest import NAME
from spike4dgs.benchmark.scene.scene import Scene


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
