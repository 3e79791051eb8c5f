"""The training part of a scene: what a fit may see, and participants of a season. It has nothing that a method must not
know.

It has the training cameras' recordings, all cameras' poses and the list of targets. Images, masks, geometry, sparse
points, the sensors' true maps, the seed, previews, and every recording of held-out cameras stay out: files come from a
list of what is allowed, and descriptions are written anew.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.files import writing
from spike4dgs.benchmark.lazy import kept_sigterm
from spike4dgs.benchmark.method import GIVEN
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene

# The recordings of a camera; a method that is not given some kinds does not get their files.
_RECORDINGS = {
    "": ("spikes/{}.",),
    "flat-field": ("calibration/flat/{}.", "calibration/dark/{}."),
    "frames": ("conventional/{}/",),
    "events": ("events/{}.",),
}
_EXTRAS = {"flat-field": "calibration", "frames": "conventional", "events": "events"}  # of scene.json
_MOST_COPIED = 1 << 30  # bytes of a part; a larger one has hard links, through which a fit could write
_MODEL = "sparse/0/"  # of COLMAP; its points are true ones, which few methods are given
_SOURCE = ("kind", "world", "variant", "profile", "seconds", "versions")  # of its source; never the seed
NAMELESS = "scene"  # the id of a part that does not say which scene it is of


def training_files(scene: Scene, given: Collection[str] = GIVEN) -> list[str]:
    """Return the paths of the training cameras' recordings in a scene, of the kinds that are `given`."""
    patterns = [p for kind, of_kind in _RECORDINGS.items() if not kind or kind in given for p in of_kind]
    wanted = {pattern.format(camera) for pattern in patterns for camera in scene.train}
    # What comes before a file's ending or its name: `cam.` also begins the files of a camera `cam.1`.
    return sorted(n for n in scene.manifest.files if {f"{n.rpartition(end)[0]}{end}" for end in "./"} & wanted)


def write_training_part(scene: Scene, folder: Path) -> Scene:
    """Write the training part of a scene, in its split, and return it opened. It says which scene it is of.

    It appears under its name when it is whole; an earlier one is replaced. Equal scenes have equal parts.
    """
    source = {key: value for key, value in scene.meta["source"].items() if key in _SOURCE}
    title = str(scene.meta.get("title", scene.id))
    description = _description(scene, scene.id, title, source, GIVEN)
    return _write(scene, folder, description, training_files(scene))


def write_nameless_part(scene: Scene, folder: Path, given: Collection[str]) -> Scene:
    """Write the training part of a scene for one fit, and return it opened: files are links where the disk has some.

    It has the recordings of the kinds that the method is `given`, and sparse/0 with the points. Nothing in it says how
    the scene was made or what it is called: with the world and the seed, a method could render the held-out views.
    """
    description = _description(scene, NAMELESS, NAMELESS, {"kind": scene.meta["source"]["kind"]}, given)
    if "points" in given:
        description = replace(description, points=_points(scene))
    return _write(scene, folder, description, training_files(scene, given))


def _points(scene: Scene) -> NDArray[np.float64]:
    """Return the points [N, 3] of the scene's COLMAP model."""
    with kept_sigterm():
        import pycolmap

    for name in scene.manifest.only(_MODEL).files:
        scene.manifest.path(name)
    model = pycolmap.Reconstruction(str(scene.root / _MODEL))
    return np.array([model.points3D[i].xyz for i in sorted(model.points3D)]).reshape(-1, 3)


def _description(
    scene: Scene, name: str, title: str, source: dict[str, object], given: Collection[str]
) -> SceneDescription:
    used = (*scene.train, *scene.test)  # a split may leave cameras out
    extras = [key for kind, key in _EXTRAS.items() if kind in given and key in scene.meta]
    return SceneDescription(
        id=name,
        title=title,
        licence=str(scene.meta["licence"]),
        cameras=tuple(scene.cameras[c] for c in sorted(scene.cameras) if c in used),
        train=scene.train,
        test=scene.test,
        rate_hz=scene.rate_hz,
        n_ticks=scene.n_ticks,
        radiance_gain=scene.radiance_gain,
        targets=scene.targets,
        sensor=scene.meta["sensor"],
        source=source,
        clock=scene.meta["clock"],
        sync=scene.meta["sync"],
        gaps=tuple(gap for gap in scene.meta["gaps"] if gap["camera"] in scene.train),
        extras={key: scene.meta[key] for key in extras},
        kept_back=scene.test,
    )


def _write(scene: Scene, folder: Path, description: SceneDescription, names: list[str]) -> Scene:
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    sources = {name: scene.manifest.path(name) for name in names}
    copied = sum(source.stat().st_size for source in sources.values()) < _MOST_COPIED
    for name, source in sources.items():
        with writing(part / name):
            (part / name).parent.mkdir(parents=True, exist_ok=True)
            if copied:
                shutil.copyfile(source, part / name)
            else:
                _link(source, part / name)
    known = replace(scene.manifest, files={name: scene.manifest.files[name] for name in names})
    finish_scene(part, description, known)
    shutil.rmtree(folder, ignore_errors=True)
    part.rename(folder)
    return open_scene(folder, allow_gaps=True)


def _link(source: Path, target: Path) -> None:
    """Make `target` a further name of a file, or a copy where the file system has no such links."""
    try:
        os.link(source.resolve(), target)  # never a symbolic link: it says where the scene lies
    except OSError:
        shutil.copyfile(source, target)
