"""Recipes on a small toy world with stand-ins for images and initialisation, for tests of the trainer."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from toy_world import ToyWorld

from spike4dgs.baselines.recipes import PARTS as BASELINE_PARTS
from spike4dgs.benchmark.method import FitRequest, Recipe
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.fit import Parts, RecipeMethod
from spike4dgs.method.gaussians.density import DensitySettings
from spike4dgs.method.gaussians.parameters import from_points
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.images.training import ImageSettings, make_training_images, wanted_images
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.schedule import TrainerSettings
from spike4dgs.method.starts.base import Initialization, Start, measure
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.trainer import Trainer
from spike4dgs.method.training_views.training_images import Spans, TrainingImages

MOTIONS = BASELINE_PARTS.motion
SUPERVISIONS = BASELINE_PARTS.supervision

WORLD = ToyWorld(width=64, height=40, n_ticks=240, travel=0.3)


def silent(done: int, total: int, note: str = "") -> None:
    pass


def checkpoints(fit: Trainer) -> dict[int, bytes]:
    """Run a fit to its end; return what its checkpoint held before each of its steps but the first."""
    found, train_step = {}, fit.train_step
    with TemporaryDirectory() as folder:
        path = Path(folder) / "fit.safetensors"

        def watched() -> Any:
            if fit.step:
                found[fit.step] = path.read_bytes()
            return train_step()

        fit.train_step = watched  # type: ignore[method-assign]
        fit.run(silent, path, "this", checkpoint_s=0)
    return found


def around(stream: SpikeStream, tick: int, settings: object) -> np.ndarray:
    """Mean of the spikes 12 ticks around."""
    a, b = max(0, tick - 12), min(stream.n_ticks, tick + 12)
    return (stream.counts(a, b) / (b - a)).astype(np.float32)


images = ImageMaker(name="short", rate=around)  # a stand-in for the images part


def surfaces(scene: TrainingScene, seed: int, world: ToyWorld = WORLD) -> Start:
    """A stand-in for the initialisation: noisy points on the true surfaces at the middle of the clip."""
    return Start(scene.cameras, *world.surfaces(scene.cameras[::2], 0.01, seed))


@cache
def ground(world: ToyWorld = WORLD, spacing: int = 40) -> tuple[Start, Extent, TrainingImages]:
    """What every trainer on a world begins with, and none changes; images lie `spacing` ticks apart."""
    scene, start, spaced = world.training, surfaces(world.training, 0, world), ImageSettings(time_spacing_ticks=spacing)
    extent = replace(measure(start, scene), images=wanted_images(scene.n_ticks, spaced))
    return start, extent, make_training_images(scene, start.cameras, images, spaced, "cpu")


def trainer(
    steps: int = 12,
    motion: str = "hexplane",
    supervision: str = "pixel",
    loss: Mapping[str, Any] | None = None,
    spans: Callable[[TrainingImages], Spans] | None = None,
    density: DensitySettings | None = None,
    of: tuple[ToyWorld, int] = (WORLD, 40),
    **settings: Any,
) -> Trainer:
    """A short fit, a third of it at rest, of the world and spacing `of`; it densifies at every second step."""
    start, extent, training_images = ground(*of)
    stages = {"coarse_steps": steps // 3, "fine_steps": steps - steps // 3, "views_per_step": 3}
    sizes = {"mlp_width": 16} if motion == "hexplane" else {}
    model = MOTIONS[motion](extent, replace(MOTIONS[motion].defaults, **sizes), seeded(0, -1))
    if spans is not None:
        training_images = replace(training_images, spans=spans(training_images))
    kind = SUPERVISIONS[supervision]
    compare = kind(replace(kind.defaults, **(loss or {})), of[0].training)
    first = model.initialize(from_points(start.points[::3], start.values[::3], opacity=0.5), training_images)
    density, numbers = density or DensitySettings(refine_every=2), TrainerSettings(**(stages | settings))
    return Trainer(training_images, first, model, compare, numbers, density, scale=extent.scale, seed=3)


TRUE = Initialization(lambda request: surfaces(request.scene, request.seed))
PARTS = Parts({"short": images}, {"true": TRUE}, MOTIONS, SUPERVISIONS)
QUICK = {"trainer.coarse_steps": 60, "trainer.fine_steps": 300, "trainer.views_per_step": 4}
SMALL_PLANES = {"motion.mlp_width": 16, "motion.features": 8}


def method(motion: str, settings: Mapping[str, Any] | None = None) -> RecipeMethod:
    quick = {**QUICK, **(SMALL_PLANES if motion == "hexplane" else {})}
    return RecipeMethod(Recipe("test", "short", "true", motion, "pixel", {**quick, **(settings or {})}), PARTS)


def request(seed: int = 0, **changes: Any) -> FitRequest:
    """A request for the quick budget on the CPU."""
    return FitRequest(seed=seed, progress=silent, **changes)
