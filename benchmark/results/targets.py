"""The images that a scene is scored on: those that it lists, or evenly spaced ones of a recording without any."""

from __future__ import annotations

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.scene import Scene, Target

PARTS = 16  # of a recording without targets; each held-out camera has one at every inner border


def targets_of(scene: Scene) -> tuple[Target, ...]:
    """Return the scene's targets; where it lists none, 15 evenly spaced ticks of each held-out camera.

    The ticks are n_ticks * k / 16, rounded. Raises UserError for a scene that holds out no camera.
    """
    if scene.targets:
        return scene.targets
    if not scene.test:
        fix = "hold out a camera: --held-out of `spike4dgs record`, or the splits in scene.json"
        raise problem(scene.root, "a held-out camera, or targets in targets.json", "neither", fix)
    ticks = sorted({round(scene.n_ticks * k / PARTS) for k in range(1, PARTS)} & set(range(scene.n_ticks)))
    return tuple(Target(camera, tick) for camera in scene.test for tick in ticks)


def has_truth(scene: Scene) -> bool:
    """Return whether the scene has ground truth: it then lists targets."""
    return bool(scene.targets)
