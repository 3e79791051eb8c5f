"""Where a scene's files lie in a release: their parts, their cameras, their names and their order.

A release is a WebDataset: the members of a shard whose names agree up to the first dot of the base name are one sample.
Here a sample is one camera of a scene, with all that belongs to it, or the scene's own files:

    car-0-small/scene.scene.json                  car-0-small: scene.json
    car-0-small/cam_00.spikes.dat                 car-0-small: spikes/cam_00.dat
    car-0-small/cam_00.images.000120.exr          car-0-small: images/cam_00/000120.exr

Names that unpack with `tar xf` into a scene folder would make a sample of every single file. So the index states the
path of each member, and `spike4dgs download --from FOLDER` unpacks.
"""

from __future__ import annotations

from collections.abc import Collection

DESCRIPTION = "description"  # the part of the files at the top of a scene folder
SCENE_SAMPLE = "scene"  # the sample of what belongs to no camera
# What comes first of a camera; other parts follow by name.
_ORDER = ("spikes", "calibration", "truth", "images", "masks", "geometry", "events", "conventional")


def part_of(path: str) -> str:
    """Return the part that a file belongs to: the folder at the top of its path, such as `spikes`, or DESCRIPTION."""
    top, _, rest = path.partition("/")
    return top if rest else DESCRIPTION


def camera_of(path: str, cameras: Collection[str]) -> str | None:
    """Return the camera that a file belongs to, by the names of its folders and its own; None for the scene's files."""
    *folders, name = path.split("/")
    named = [word for word in (*folders, name.partition(".")[0]) if word in cameras]
    return named[0] if folders and named else None


def member_name(scene: str, path: str, camera: str | None) -> str:
    """Return the name of a file in its shard: SCENE/SAMPLE.REST, the rest being the path with dots for slashes."""
    words = path.split("/")
    if camera is not None:
        words[-1] = words[-1].removeprefix(f"{camera}.")
        words = [word for word in words if word != camera]
    return f"{scene}/{SCENE_SAMPLE if camera is None else camera}.{'.'.join(words)}"


def order_of(path: str, camera: str | None) -> tuple[str, int, str]:
    """Return a file's place in its scene: the scene's own files first, then camera by camera."""
    part = part_of(path)
    rank = -1 if part == DESCRIPTION else _ORDER.index(part) if part in _ORDER else len(_ORDER)
    return camera or "", rank, path
