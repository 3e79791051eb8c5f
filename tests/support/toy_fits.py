"""Recipes on a small toy world with stand-ins for images and initialisation, for tests of the trainer."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from toy_world import ToyWorld

from spike4dgs.benchmark.method import Recipe
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.fit import Parts, RecipeMethod, Start
from spike4dgs.method.motion.table import MOTIONS
from spike4dgs.method.supervision.table import SUPERVISIONS

WORLD = ToyWorld(width=64, height=40, n_ticks=240, travel=0.3)


def silent(done: int, total: int, note: str = "") -> None:
    pass


def images(stream: SpikeStream, ticks: Sequence[int], gain: float) -> np.ndarray:
    """A stand-in for the images part: mean of the spikes 12 ticks around."""
    spans = [(max(0, t - 12), min(stream.n_ticks, t + 12)) for t in ticks]
    return np.stack([stream.counts(a, b) / ((b - a) * gain) for a, b in spans]).astype(np.float32)


def surfaces(scene: TrainingScene, seed: int) -> Start:
    """A stand-in for the initialisation: noisy points on the true surfaces at the middle of the clip."""
    return Start(scene.cameras, *WORLD.surfaces(scene.cameras[::2], 0.01, seed))


PARTS = Parts({"short": images}, {"true": surfaces}, MOTIONS, SUPERVISIONS)
QUICK = {"coarse_steps": 60, "fine_steps": 300, "mlp_width": 16, "features": 8, "views_per_step": 4}


def method(motion: str, **settings: float) -> RecipeMethod:
    return RecipeMethod(Recipe("test", "short", "true", motion, "pixel", {**QUICK, **settings}), PARTS)
