"""A recipe as a method: pictures from spikes, first points, the trainer, and a model that renders."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spike4dgs.benchmark.cameras import Camera
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_json
from spike4dgs.benchmark.recipes import Budget, Progress, Recipe
from spike4dgs.benchmark.scene import TrainingScene
from spike4dgs.benchmark.spikes import SpikeStream
from spike4dgs.method.gaussians import Gaussians, from_points
from spike4dgs.method.motion import Extent, Motion
from spike4dgs.method.settings import TrainSettings, make_settings
from spike4dgs.method.splat import Views, render
from spike4dgs.method.supervision import Supervision
from spike4dgs.method.trainer import Footage, Trainer, seeded

Float32 = NDArray[np.float32]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Start:
    """What an initialisation gives: a pose for each training camera, and first points on surfaces."""

    cameras: tuple[Camera, ...]
    points: Float32  # [N, 3] m
    values: Float32  # [N] gray radiance


ImageMaker = Callable[[SpikeStream, Sequence[int], float], Float32]  # stream, ticks, gain -> [n, H, W] radiance
Initialization = Callable[[TrainingScene, int], Start]  # scene, seed
MotionMaker = Callable[[Extent, TrainSettings, torch.Generator], Motion]
SupervisionMaker = Callable[[TrainSettings, TrainingScene], Supervision]


@dataclass(frozen=True)
class Parts:
    """The tables that a recipe's four names are looked up in."""

    images: Mapping[str, ImageMaker]
    initialization: Mapping[str, Initialization]
    motion: Mapping[str, MotionMaker]
    supervision: Mapping[str, SupervisionMaker]


@dataclass(frozen=True, eq=False)
class FittedModel:
    """Gaussians and how they move."""

    gaussians: Gaussians
    motion: Motion
    duration_us: float
    device: str

    @torch.no_grad()
    def render(self, camera: Camera, t_us: float) -> Float32:
        """Gray linear radiance [H, W] float32 that `camera` sees at `t_us`; times outside the clip take its ends."""
        t = min(max(t_us / self.duration_us, 0.0), 1.0)
        splats = self.motion.deform(self.gaussians, t).splats()
        image = render(splats, Views.from_cameras([camera], device=self.device)).image[0, :, :, 0]
        return image.clamp(min=0).cpu().numpy()


class RecipeMethod:
    """`benchmark.recipes.Method` for a recipe whose parts are found in `parts`.

    `params` holds the recipe and all settings of the trainer, overridden or not. Raises UserError for unknown settings.
    """

    def __init__(self, recipe: Recipe, parts: Parts) -> None:
        self.name, self.recipe, self.parts = recipe.name, recipe, parts
        self.settings = make_settings(recipe.settings, f"recipe {recipe.name}")
        self.params: dict[str, Any] = {**recipe.as_dict(), "settings": asdict(self.settings)}

    def fit(
        self,
        scene: TrainingScene,
        budget: Budget,
        device: str,
        seed: int,
        progress: Progress,
        checkpoint: Path | None = None,
    ) -> FittedModel:
        """Fit the training views; see `benchmark.recipes.Method`.

        Raises UserError for an unknown part or setting, a foreign checkpoint, or a device that is not there.
        """
        check_device(device)
        recipe, parts = self.recipe, self.parts
        settings = self.settings.scaled(budget.scale)
        images = _part(parts.images, recipe.images, recipe, "images")
        initialize = _part(parts.initialization, recipe.initialization, recipe, "initialization")
        make_motion = _part(parts.motion, recipe.motion, recipe, "motion")
        supervise = _part(parts.supervision, recipe.supervision, recipe, "supervision")
        progress(0, 1, "initialisation")
        start = initialize(scene, seed)
        extent = measure(start, scene)
        motion = make_motion(extent, settings, seeded(seed, -1))
        if isinstance(motion, torch.nn.Module):
            motion.to(device)
        progress(0, 1, "pictures")
        footage = film(scene, start.cameras, images, settings, device)
        first = from_points(start.points, start.values, opacity=settings.initial_opacity, device=device)
        trainer = Trainer(footage, first, motion, supervise(settings, scene), settings, scale=extent.scale, seed=seed)
        trainer.run(progress, checkpoint, sha256_json([scene.revision, self.params, budget.scale, seed]))
        gaussians = trainer.gaussians.rows(torch.arange(len(trainer.gaussians), device=device))
        return FittedModel(gaussians, motion, scene.duration_us, device)


def _part(table: Mapping[str, T], name: str, recipe: Recipe, part: str) -> T:
    if name not in table:
        raise problem(f"recipe {recipe.name}", f"{part} among {', '.join(sorted(table))}", repr(name), "correct it")
    return table[name]


def check_device(device: str) -> None:
    """Raise UserError unless torch can compute on `device`."""
    try:
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as e:
        found = f"{device!r} ({str(e).splitlines()[0][:80]})"
        raise problem("device", "cpu, or a CUDA device of this machine", found, "use --device cpu") from None


def choose_ticks(n_ticks: int, settings: TrainSettings) -> tuple[int, ...]:
    """Ticks of the training pictures: evenly spaced, an edge away from the clip's ends, where windows are cut."""
    edge = min(settings.edge_ticks, (n_ticks - 1) // 2)
    span = n_ticks - 2 * edge
    count = min(settings.max_times, max(1, round(span / settings.time_spacing_ticks) + 1))
    return tuple(sorted({int(t) for t in np.rint(np.linspace(edge, n_ticks - 1 - edge, count))}))


def film(
    scene: TrainingScene, cameras: Sequence[Camera], images: ImageMaker, settings: TrainSettings, device: str
) -> Footage:
    """Pictures of all training views at the chosen times."""
    ticks = choose_ticks(scene.n_ticks, settings)
    pictures = np.stack([images(stream, ticks, scene.radiance_gain) for stream in scene.streams], axis=1)
    views = Views.from_cameras(cameras, device=device)
    return Footage(views, ticks, torch.from_numpy(pictures).to(device), scene.n_ticks)


def measure(start: Start, scene: TrainingScene) -> Extent:
    """The scene's box and size, from the points seen and not only from the array, which is small beside the scene.

    The box holds 98 % of the points on each axis and a margin of a tenth. Size: the larger of 1.1 x the array's radius
    (3DGS) and half the points' median distance.
    """
    centers = np.stack([c.center for c in start.cameras])
    middle = centers.mean(axis=0)
    low, high = np.quantile(start.points, [0.01, 0.99], axis=0)
    margin = 0.1 * (high - low) + 1e-3 * float((high - low).max())
    distance = float(np.median(np.linalg.norm(start.points - middle, axis=1)))
    scale = max(1.1 * float(np.linalg.norm(centers - middle, axis=1).max()), 0.5 * distance)

    def tensor(a: NDArray[np.float64]) -> Tensor:
        return torch.as_tensor(a, dtype=torch.float32)

    return Extent(tensor(low - margin), tensor(high + margin), scale, scene.n_ticks, start.cameras[0].width)
