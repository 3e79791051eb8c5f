"""A small synthetic scene folder, and the optional real recordings."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.benchmark.scene.images import write_exr, write_mask
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import Target
from spike4dgs.benchmark.scene.splits import standard_splits
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene, stream_name
from spike4dgs.benchmark.spikes.stream import SpikeWriter, pack

WIDTH, HEIGHT, TICKS, GAIN = 40, 24, 80, 0.6


def shared_file(name: str) -> Path:
    """A file of the optional folder of real recordings; the test is skipped where it is absent."""
    root = Path(os.environ.get("SPIKE4DGS_SHARED", Path(__file__).resolve().parents[3] / "shared"))
    if not (root / name).is_file():
        pytest.skip(f"{name} is not here (set SPIKE4DGS_SHARED to the folder that holds it)")
    return root / name


def array_cameras(n: int = 4, width: int = WIDTH, height: int = HEIGHT) -> tuple[Camera, ...]:
    """Cameras in a row that look at the origin from 3 m away."""
    up, size = np.array([0.0, 0.0, 1.0]), {"focal": 1.2 * width, "width": width, "height": height}
    at = [np.array([0.15 * (i - 1.5), -3.0, 0.8]) for i in range(n)]
    return tuple(look_at(f"cam_{i:02d}", center, np.zeros(3), up, **size) for i, center in enumerate(at))


def write_small_scene(
    root: Path,
    seed: int = 0,
    splits: bool = False,
    extras: Mapping[str, dict[str, Any]] | None = None,
    width: int = WIDTH,
    height: int = HEIGHT,
) -> Path:
    """A scene without Mitsuba: a pattern that drifts to the right; cam_03 is held out, targets every 20 ticks.

    With `splits` it has the standard ones; `corner` holds out cam_00, with two targets.
    """
    rng = np.random.default_rng(seed)
    cameras = array_cameras(width=width, height=height)
    y, x = np.mgrid[:height, :width].astype(np.float64)
    targets = tuple(Target("cam_03", t) for t in (20, 40, 60))
    if splits:
        targets += (Target("cam_00", 30), Target("cam_00", 50))

    def radiance(camera: int, tick: float) -> np.ndarray:
        return 0.45 + 0.3 * np.sin((x - 0.1 * tick - 2 * camera) / 4) * np.cos(y / 5)

    for i, c in enumerate(cameras):
        charge = rng.random((height, width))
        with SpikeWriter(root / stream_name(c.id), width, height) as writer:
            for tick in range(TICKS):
                charge += GAIN * radiance(i, tick + 0.5)
                fired = charge >= 1
                charge -= fired
                writer.write(pack(fired[None]))
    for t in targets:
        image = radiance(int(t.camera[-1]), t.tick).astype(np.float32)
        write_exr(root / f"images/{t.name}.exr", image, t.tick * 50.0)
        write_mask(root / f"masks/{t.name}.png", np.abs(x - 20) < 8)
    sensor = {"model": "integrate-and-fire/1", "rows_bottom_up": True}
    ids = [c.id for c in cameras]
    about = {"id": f"pattern-{seed}", "title": "A drifting pattern", "licence": "CC0-1.0", "source": {"kind": "test"}}
    clock = {"rate_hz": 20000.0, "n_ticks": TICKS, "radiance_gain": GAIN, "sensor": sensor}
    array = {"cameras": cameras, "train": tuple(ids[:3]), "test": (ids[3],), "targets": targets}
    array |= {"points": rng.normal(size=(30, 3)), "splits": standard_splits(cameras, "cam_03") if splits else {}}
    finish_scene(root, SceneDescription(**about, **clock, **array, extras=extras or {}))
    return root


def lose_ticks(scene: Path, camera: str, first_tick: int, ticks: int) -> None:
    """Set ticks of a camera to zero, as a recorder leaves what it lost, and state the gap."""
    path, a_tick = scene / stream_name(camera), WIDTH * HEIGHT // 8
    data = bytearray(path.read_bytes())
    data[first_tick * a_tick : (first_tick + ticks) * a_tick] = bytes(ticks * a_tick)
    path.write_bytes(data)
    add_gap(scene, camera, first_tick, ticks)


def add_gap(scene: Path, camera: str, first_tick: int, ticks: int) -> None:
    """State in a scene's files that ticks of a camera are missing."""
    meta = json.loads((scene / "scene.json").read_text())
    gap = {"camera": camera, "first_tick": first_tick, "ticks": ticks, "reason": "test"}
    (scene / "scene.json").write_text(json.dumps({**meta, "gaps": [*meta["gaps"], gap]}))
    write_manifest(scene)
