"""A copy of a scene with counted recordings of light and darkness: most of the bytes gone, the revision the same."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from spike4dgs.benchmark import croissant as croissant
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import check_new, read_json, write_bytes, writing
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.spikes.counted_recording import encode_recording


def counted_copy(scene: Scene, out: Path) -> Scene:
    """Write the scene to the new folder `out`, its recordings counted, and return the copy, which has its revision.

    Raises UserError where `out` is not new, and where a file is missing or damaged.
    """
    check_new(out)
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    try:
        for name in scene.manifest.files:
            if not name.startswith(("calibration/flat/", "calibration/dark/")):
                _copy(scene.manifest.path(name), part / name)
        for camera in scene.cameras:
            if found := scene.recordings(camera):
                for kind, recording in (("flat", found.flat), ("dark", found.dark)):
                    write_bytes(part / f"calibration/{kind}/{camera}.npz", encode_recording(recording))
        if (part / croissant.NAME).is_file():
            about = read_json(part / croissant.NAME, "a scene's description")["description"]
            croissant.write_croissant(part, scene.meta, str(about))
        write_manifest(part)
        if (found_revision := open_scene(part, allow_gaps=True).revision) != scene.revision:
            fix = "check it with `spike4dgs verify`"
            raise problem(scene.root, f"revision {scene.revision[:16]}...", f"{found_revision[:16]}...", fix)
        with writing(out):
            os.replace(part, out)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return open_scene(out, allow_gaps=True, split=scene.split)


def _copy(source: Path, target: Path) -> None:
    with writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
