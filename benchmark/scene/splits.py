"""Splits: the training and held-out cameras of a scene, its scored images, and the standard splits of an array."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.untrusted import check_ids

DEFAULT_SPLIT = "center"
_FEWEST, _MOST = 3, 8  # training views of the splits views-N
_AGAIN = "make or import the scene again"


class Split(NamedTuple):
    """Cameras by id."""

    train: tuple[str, ...]
    test: tuple[str, ...]


@dataclass(frozen=True, order=True)
class Target:
    """One scored image: a held-out camera at a tick."""

    camera: str
    tick: int

    @property
    def name(self) -> str:
        """The image's path below `images/` or a predictions folder, without suffix: `cam_04/000120`."""
        return f"{self.camera}/{self.tick:06d}"


def standard_splits(cameras: Sequence[Camera], held_out: str) -> dict[str, Split]:
    """Return the splits of an array by name, as far as it has enough cameras; `held_out` is the camera in its middle.

    - `center`: test on `held_out`, train on all others (interpolation; the default).
    - `corner`: test on the camera farthest from `held_out`, train on all others (extrapolation); from 3 cameras on.
    - `views-3` .. `views-8`: test on `held_out`, train on the first so many cameras of `spread_order`.

    In a 3x3 array named row by row around cam_04, `corner` holds out cam_00, and the order is 0, 8, 2, 6 (the
    corners), then the middles of the long sides, then of the short ones: `views-8` trains on what `center` does.
    Raises UserError where `held_out` is none of the cameras, or the only one.
    """
    ids = tuple(c.id for c in cameras)
    if held_out not in ids or len(ids) < 2:
        raise problem("cameras", f"{held_out} and others", ", ".join(ids) or "none", "name a camera of the array")
    order = spread_order(cameras, held_out)

    def split(test: str, train: Sequence[str]) -> Split:
        return Split(tuple(c for c in ids if c in train), (test,))

    splits = {DEFAULT_SPLIT: split(held_out, order)}
    if len(ids) > 2:
        splits["corner"] = split(order[0], [c for c in ids if c != order[0]])
    for n in range(_FEWEST, min(_MOST, len(order)) + 1):
        splits[f"views-{n}"] = split(held_out, order[:n])
    return splits


def spread_order(cameras: Sequence[Camera], held_out: str) -> tuple[str, ...]:
    """Return the cameras other than `held_out`, ordered so that any number of the first ones is spread over the array.

    First the camera that is farthest from `held_out`, then always the one whose nearest camera among those already
    taken is farthest away. Of equally far ones (to 1e-6 of the array's extent) the first in `cameras` is taken.
    """
    left = [c for c in cameras if c.id != held_out]
    taken = [c for c in cameras if c.id == held_out]
    extent = max(float(np.linalg.norm(a.center - b.center)) for a in cameras for b in cameras) or 1.0
    order: list[Camera] = []
    while left:
        near = [min(float(np.linalg.norm(c.center - o.center)) for o in order or taken) for c in left]
        order.append(left.pop(int(np.argmax(np.round(np.array(near) / extent, 6)))))
    return tuple(c.id for c in order)


def check_splits(meta: Mapping[str, Any], cameras: Mapping[str, Camera], path: Path) -> None:
    """Raise UserError unless the splits of scene.json name known cameras, and none of them in both parts.

    All cameras have the size that scene.json states, and each stream has a pose. Held-out cameras may lack a stream:
    the training part of a hidden scene keeps theirs back. Ids that differ in case alone are refused too.
    """
    check_ids(meta["splits"], "split", path)
    check_ids(meta["streams"], "camera", path)
    if meta["default_split"] not in meta["splits"]:
        raise problem(path, "default_split among the splits", repr(meta["default_split"]), "correct scene.json")
    for split, parts in meta["splits"].items():
        both = set(parts["train"]) & set(parts["test"])
        unknown = set(parts["test"]) - set(cameras) | set(parts["train"]) - (set(cameras) & set(meta["streams"]))
        if both or unknown:
            found = f"{', '.join(sorted(both | unknown))} {'in both parts' if both else 'without pose or stream'}"
            raise problem(path, f"split {split} of known, distinct cameras", found, _AGAIN)
    if lost := sorted(set(meta["streams"]) - set(cameras)):
        raise problem(path, "a pose of every stream", f"{', '.join(lost)} without", _AGAIN)
    size = meta["width"], meta["height"]
    for camera in cameras.values():
        if (camera.width, camera.height) != size:
            found = f"{camera.id} of {camera.width}x{camera.height}"
            raise problem(path, f"cameras of {size[0]}x{size[1]} pixels", found, _AGAIN)


def splits_of(meta: Mapping[str, Any]) -> dict[str, Split]:
    """Return the splits that scene.json states, by name."""
    return {name: Split(tuple(s["train"]), tuple(s["test"])) for name, s in meta["splits"].items()}


def read_targets(path: Path, meta: dict[str, Any]) -> dict[str, tuple[Target, ...]]:
    """Read the targets of every split: splits that hold out the same cameras as the default one have its targets."""
    data = read_json(path, "the scored images")
    splits = splits_of(meta)
    held_out = splits[meta["default_split"]].test
    try:
        default = _parse_targets(data["targets"])
        others = {str(name): _parse_targets(targets) for name, targets in data.get("splits", {}).items()}
    except (KeyError, TypeError, ValueError, AttributeError) as e:
        raise problem(path, "lists of {camera, tick}", repr(e), "restore it or make the scene again") from None
    needed = {name for name, s in splits.items() if set(s.test) != set(held_out)}
    if set(others) != needed:
        found = ", ".join(sorted(others)) or "none"
        raise problem(path, f"targets of the splits {', '.join(sorted(needed)) or '(none)'}", found, "restore the file")
    targets = {name: others.get(name, default) for name in splits}
    for name, of_split in targets.items():
        _check_targets(path, of_split, splits[name].test, meta["n_ticks"])
    return targets


def _parse_targets(items: list[dict[str, Any]]) -> tuple[Target, ...]:
    return tuple(Target(str(t["camera"]), int(t["tick"])) for t in items)


def _check_targets(path: Path, targets: tuple[Target, ...], held_out: tuple[str, ...], n_ticks: int) -> None:
    for i, t in enumerate(targets):
        found = f"{t.camera} at tick {t.tick}"
        if t.camera not in held_out or not 0 <= t.tick < n_ticks:
            raise problem(path, "held-out cameras and ticks of this scene", found, "restore the file")
        if t in targets[:i]:
            raise problem(path, "distinct targets", f"{found} twice", "restore the file")
