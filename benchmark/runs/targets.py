"""The images that a scene is scored on: those that it lists, or every millisecond of a recording without any."""

from __future__ import annotations

import numpy as np

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.scene import Scene, Target

EVERY_MS = 1.0  # between the ticks of a recording without targets, as in made scenes,
MOST = 32  # and of each held-out camera's; longer clips have as many, evenly spread


def targets_of(scene: Scene) -> tuple[Target, ...]:
    """Return the scene's targets; where it lists none, every millisecond of each held-out camera.

    The ticks lie strictly inside the clip, and are at most `MOST`. Raises UserError where no camera is held out.
    """
    if scene.targets:
        return scene.targets
    if not scene.test:
        fix = "hold out a camera: --held-out of `spike4dgs record`, or the splits in scene.json"
        raise problem(scene.root, "a held-out camera, or targets in targets.json", "neither", fix)
    every = max(1, round(scene.rate_hz * EVERY_MS * 1e-3))
    inside = range(every, scene.n_ticks - every + 1, every) or range(scene.n_ticks // 2, scene.n_ticks // 2 + 1)
    chosen = sorted({round(i) for i in np.linspace(0, len(inside) - 1, min(MOST, len(inside)))})
    ticks = [inside[i] for i in chosen]
    return tuple(Target(camera, tick) for camera in scene.test for tick in ticks)


def has_truth(scene: Scene) -> bool:
    """Return whether the scene has ground truth. One that lists targets may keep their images back."""
    return any(f"images/{t.name}.exr" in scene.manifest.files for t in scene.targets)
