"""What a conventional camera and an event camera record of a toy world, as files and as a method is given them."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from toy_world import RATE_HZ, ToyWorld

from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import encode_srgb, write_png
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.other_sensors import find_events, find_frames, write_events
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.generators.other_sensors import EXPOSURE_S, FPS, events, exposures

KEY_TICKS = 4


@lru_cache(maxsize=8)
def keys_of(world: ToyWorld, camera: Camera) -> tuple[np.ndarray, tuple[int, ...]]:
    """Radiance keys [K, H, W] float32 of a camera, and their ticks."""
    ticks = tuple(range(0, world.n_ticks + KEY_TICKS, KEY_TICKS))
    return np.stack([world.trace(camera, t / world.n_ticks)[0] for t in ticks]).astype(np.float32), ticks


def record(world: ToyWorld, root: Path, threshold: float) -> TrainingScene:
    """Write frames and events of the training cameras below `root`; return the world's scene with them."""
    scene = world.training
    meta: dict[str, Any] = {"rate_hz": RATE_HZ, "n_ticks": world.n_ticks, "width": world.width, "height": world.height}
    meta |= {"conventional": {"fps": FPS, "exposure_s": EXPOSURE_S}, "events": {"threshold": threshold}}
    for camera in scene.cameras:
        keys, ticks = keys_of(world, camera)
        for tick, image in exposures(keys, ticks, world.n_ticks, int(RATE_HZ)):
            write_png(root / f"conventional/{camera.id}/{tick:06d}.png", encode_srgb(image))
        write_events(root / f"events/{camera.id}.npz", events(keys, ticks, world.n_ticks, int(RATE_HZ), threshold))
    write_json(root / "scene.json", meta)
    manifest, names = write_manifest(root), [camera.id for camera in scene.cameras]
    return replace(
        scene, found_frames=find_frames(meta, manifest, names), found_events=find_events(meta, manifest, names)
    )
