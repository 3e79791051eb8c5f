"""Facts of two scenes that no noise changes: clock, cameras, splits, targets, geometry, sensors.

Numbers that differ by rounding alone count as equal: another processor or library may round otherwise.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from spike4dgs.benchmark.scene.cameras import camera_facts
from spike4dgs.benchmark.scene.images import Geometry, read_geometry
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.spikes.counted import counted
from spike4dgs.benchmark.untrusted.npz import read_npz

_ROUNDING = 1e-9  # relative, of facts in float64
_MAP_ROUNDING = 1e-5  # relative, of the sensors' maps, which are float32
_DEPTH = 1e-3  # relative: what a ray hits, in float32
MOST_PIXELS = 1e-3  # share of pixels, on edges, where rays may hit another thing by rounding


def differing_facts(made: Scene, reference: Scene) -> list[str]:
    """Return one line for each fact that differs by more than rounding; none for scenes of one world and one sensor."""
    own, other = _facts(made), _facts(reference)
    found = [
        f"{name}: {_how(own.get(name), other.get(name))}"
        for name in sorted(own.keys() | other.keys())
        if not _same(own.get(name), other.get(name))
    ]
    return found or [*_sensors(made, reference), *_geometry(made, reference)]


def _facts(scene: Scene) -> dict[str, Any]:
    meta = scene.meta
    by_camera = camera_facts(scene.root).items()
    cameras = {f"{key} of {name}": value for name, own in by_camera for key, value in own.items()}
    targets = {
        f"targets of {split}": [t.name for t in open_scene(scene.root, allow_gaps=True, split=split).targets]
        for split in meta["splits"]
    }
    names = "rate_hz", "n_ticks", "radiance_gain", "width", "height", "sensor", "gaps", "default_split", "calibration"
    facts = {name: meta.get(name) for name in names}
    return {**facts, **cameras, **targets, **{f"split {name}": split for name, split in meta["splits"].items()}}


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, float) and isinstance(b, float | int):
        return abs(a - b) <= _ROUNDING * max(1.0, abs(a))
    return bool(a == b)


def _how(own: Any, other: Any) -> str:
    if isinstance(own, list) and isinstance(other, list) and own and len(own) == len(other):
        if all(isinstance(value, float | list) for value in (*own, *other)):  # a pose or a lens
            return f"by up to {np.abs(np.subtract(own, other)).max():.3g}"
    return f"{_short(own)}, reference {_short(other)}"


def _short(value: Any) -> str:
    text = "none" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _sensors(made: Scene, reference: Scene) -> Iterator[str]:
    """Yield a line for each camera whose maps, or counts under uniform light and in the dark, differ."""
    for camera in made.cameras:
        maps = [_maps(scene, camera) for scene in (made, reference)]
        if maps[0].keys() != maps[1].keys() or any(
            not np.allclose(maps[0][name], maps[1][name], rtol=_MAP_ROUNDING, atol=0) for name in maps[0]
        ):
            yield f"gain or dark map of {camera}"
            continue
        own, other = made.recordings(camera), reference.recordings(camera)
        for kind in ("flat", "dark") if own and other else ():
            counts = [counted(getattr(recordings, kind)).total for recordings in (own, other)]
            share = float(np.mean(counts[0] != counts[1]))
            if share > MOST_PIXELS:
                yield f"{kind} recording of {camera}: other counts at {share:.2%} of the pixels"


def _maps(scene: Scene, camera: str) -> dict[str, Any]:
    name = f"truth/{camera}.npz"
    return read_npz(scene.manifest.path(name), "a sensor's maps") if name in scene.manifest.files else {}


def _geometry(made: Scene, reference: Scene) -> Iterator[str]:
    """Yield a line where another thing or another depth lies under some images: how many, and the worst."""
    names = [n for n in made.manifest.files if n.startswith("geometry/") and n in reference.manifest.files]
    shares = {n: _other_geometry(*(read_geometry(s.manifest.path(n)) for s in (made, reference))) for n in names}
    if differing := {share: name for name, share in shares.items() if share > MOST_PIXELS}:
        worst = max(differing)
        count = sum(share > MOST_PIXELS for share in shares.values())
        yield f"depth or thing in {count} of {len(names)} images, most in {differing[worst]}: {worst:.2%} of the pixels"


def _other_geometry(a: Geometry, b: Geometry) -> float:
    """Return the share of the pixels whose depth or thing differs."""
    near = np.isclose(a.depth, b.depth, rtol=_DEPTH, atol=0)  # infinite depths are equal
    return float(np.mean(~near | (a.ids != b.ids)))
