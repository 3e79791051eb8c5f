"""The training part of a hidden scene: what participants may see. It holds nothing that a method must not know.

It has the training cameras' recordings, all cameras' poses and the list of targets. Images, masks, geometry, sparse
points, the sensors' true maps, the seed, previews, and every recording of held-out cameras stay out: files are copied
from a list of what is allowed, and descriptions are written anew.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene

_RECORDINGS = ("spikes/{}.", "calibration/flat/{}.", "calibration/dark/{}.", "conventional/{}/", "events/{}.")
_EXTRAS = ("conventional", "events", "calibration")  # of scene.json
_SOURCE = ("kind", "world", "variant", "profile", "seconds", "versions")  # of its source; never the seed


def training_files(scene: Scene) -> list[str]:
    """Return the paths of the training cameras' recordings in a scene."""
    prefixes = tuple(pattern.format(camera) for pattern in _RECORDINGS for camera in scene.train)
    return sorted(name for name in scene.manifest.files if name.startswith(prefixes))


def write_training_part(scene: Scene, folder: Path) -> Scene:
    """Write the training part of a scene, in its default split, and return it opened.

    It appears under its name when it is whole; an earlier one is replaced. Equal scenes have equal parts.
    """
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    for name in training_files(scene):
        (part / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(scene.manifest.path(name), part / name)
    finish_scene(
        part,
        SceneDescription(
            id=scene.id,
            title=str(scene.meta.get("title", scene.id)),
            licence=str(scene.meta["licence"]),
            cameras=tuple(scene.cameras[c] for c in sorted(scene.cameras)),
            train=scene.train,
            test=scene.test,
            rate_hz=scene.rate_hz,
            n_ticks=scene.n_ticks,
            radiance_gain=scene.radiance_gain,
            targets=scene.targets,
            sensor=scene.meta["sensor"],
            source={key: value for key, value in scene.meta["source"].items() if key in _SOURCE},
            clock=scene.meta["clock"],
            sync=scene.meta["sync"],
            gaps=tuple(gap for gap in scene.meta["gaps"] if gap["camera"] in scene.train),
            extras={key: scene.meta[key] for key in _EXTRAS if key in scene.meta},
            kept_back=scene.test,
        ),
    )
    shutil.rmtree(folder, ignore_errors=True)
    part.rename(folder)
    return open_scene(folder, allow_gaps=True)
