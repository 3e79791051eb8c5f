"""A recipe as a method: images from spikes, first points, the trainer, and a model that renders."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_json
from spike4dgs.benchmark.method import Budget, Model, Progress, Recipe
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.fitted_model import FittedModel, MotionSpec
from spike4dgs.method.gaussians.parameters import from_points
from spike4dgs.method.motion.table import PUBLISHED, Extent, Motion
from spike4dgs.method.observations.training_images import TrainingImages
from spike4dgs.method.settings import TrainSettings, make_settings
from spike4dgs.method.splat import Views
from spike4dgs.method.supervision.base import Supervision
from spike4dgs.method.trainer import Trainer, seeded

Float32 = NDArray[np.float32]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Start:
    """What an initialisation gives: a pose for each training camera, and first points on surfaces."""

    cameras: tuple[Camera, ...]
    points: Float32  # [N, 3] m
    values: Float32  # [N] gray radiance


Initialization = Callable[[TrainingScene, int], Start]  # scene, seed
MotionMaker = Callable[[Extent, TrainSettings, torch.Generator], Motion]
SupervisionMaker = Callable[[TrainSettings, TrainingScene], Supervision]


class ImageMaker(Protocol):
    """Images from spikes, corrected if the camera's calibration is given; `spike_to_image.images` says more."""

    def __call__(
        self, stream: SpikeStream, ticks: Sequence[int], gain: float, camera: Calibration | None = None
    ) -> Float32:
        """Linear radiance [n, H, W]; `gain` is spikes per tick of white."""
        ...


class FitSettings(Protocol):
    """What every algorithm's settings have: when images are made, and how a budget changes the step counts."""

    @property
    def time_spacing_ticks(self) -> int:
        """Ticks between two training images."""
        ...

    @property
    def edge_ticks(self) -> int:
        """Ticks at the clip's ends without an image."""
        ...

    @property
    def max_times(self) -> int:
        """The most training images a view."""
        ...

    @property
    def flat_field(self) -> bool:
        """Whether images are corrected by the cameras' calibrations."""
        ...

    def scaled(self, scale: float) -> FitSettings:
        """The same settings with the step counts multiplied by a budget's scale."""
        ...


@dataclass(frozen=True, eq=False)
class FitJob:
    """Everything that an algorithm fits from and reports to. `key` identifies the fit that a checkpoint belongs to."""

    scene: TrainingScene
    start: Start
    training_images: TrainingImages
    extent: Extent
    settings: Any  # the algorithm's own, scaled by the budget
    device: str
    seed: int
    progress: Progress
    checkpoint: Path | None
    key: str


@dataclass(frozen=True)
class Algorithm:
    """A fitting loop, the defaults of its settings, the step counts of its publication, and what it compares.

    `supervisions` names what the loop itself implements; empty for the trainer, which takes any of the table.
    """

    settings: FitSettings
    fit: Callable[[FitJob], Model]
    published: Mapping[str, float] = field(default_factory=dict)
    supervisions: tuple[str, ...] = ()


@dataclass(frozen=True)
class Parts:
    """The tables that a recipe's four names are looked up in. `algorithms` are motions with a loop of their own."""

    images: Mapping[str, ImageMaker]
    initialization: Mapping[str, Initialization]
    motion: Mapping[str, MotionMaker]
    supervision: Mapping[str, SupervisionMaker]
    algorithms: Mapping[str, Algorithm] = field(default_factory=dict)


class RecipeMethod:
    """`benchmark.recipes.Method` for a recipe whose parts are found in `parts`.

    `params` holds the recipe and all settings of the trainer, overridden or not. Raises UserError for unknown settings.
    """

    def __init__(self, recipe: Recipe, parts: Parts) -> None:
        self.name, self.recipe, self.parts = recipe.name, recipe, parts
        self.algorithm = parts.algorithms.get(recipe.motion) or self._trainer()
        self.settings = make_settings(recipe.settings, f"recipe {recipe.name}", self.algorithm.settings)
        self.params: dict[str, Any] = {**recipe.as_dict(), "settings": asdict(self.settings)}  # type: ignore[call-overload]
        self.trained_on: tuple[str, ...] = ()
        if learned := getattr(parts.images.get(recipe.images), "learned", lambda: None)():
            self.params["weights_sha256"], self.trained_on = learned.sha256, learned.trained_on

    def fit(
        self,
        scene: TrainingScene,
        budget: Budget,
        device: str,
        seed: int,
        progress: Progress,
        checkpoint: Path | None = None,
    ) -> Model:
        """Fit the training views; see `benchmark.recipes.Method`.

        Raises UserError for an unknown part or setting, a foreign checkpoint, or a device that is not there.
        """
        check_device(device)
        recipe, parts = self.recipe, self.parts
        settings = self._for(budget)
        images = _part(parts.images, recipe.images, recipe, "images")
        initialize = _part(parts.initialization, recipe.initialization, recipe, "initialization")
        _part({**parts.motion, **parts.algorithms}, recipe.motion, recipe, "motion")
        own = dict.fromkeys(self.algorithm.supervisions)
        _part(own or parts.supervision, recipe.supervision, recipe, "supervision")
        progress(0, 1, "initialisation")
        start = initialize(scene, seed)
        progress(0, 1, "images")
        footage = make_training_images(scene, start.cameras, images, settings, device)
        key = sha256_json([scene.revision, self.params, budget.label, seed])
        extent = measure(start, scene)
        job = FitJob(scene, start, footage, extent, settings, device, seed, progress, checkpoint, key)
        return self.algorithm.fit(job)

    def _trainer(self) -> Algorithm:
        """The one trainer, with the recipe's motion and supervision."""
        recipe, parts = self.recipe, self.parts

        def fit(job: FitJob) -> FittedModel:
            spec = MotionSpec(recipe.motion, job.extent, job.settings)
            return fit_gaussians(job, spec, parts.motion[recipe.motion], parts.supervision[recipe.supervision])

        return Algorithm(TrainSettings(), fit, PUBLISHED.get(recipe.motion, {}))

    def _for(self, budget: Budget) -> Any:
        if not budget.published:
            return self.settings.scaled(budget.scale)
        where = f"recipe {self.name}"
        if not (steps := self.algorithm.published):
            fix = "choose another budget"
            raise problem(where, "a publication's step counts for --budget paper", "none", fix)
        return make_settings(steps, where, self.settings)


def fit_gaussians(job: FitJob, spec: MotionSpec, make_motion: MotionMaker, supervise: SupervisionMaker) -> FittedModel:
    """Run the trainer on Gaussians that start at the job's points."""
    settings, start = job.settings, job.start
    motion = make_motion(spec.extent, spec.settings, seeded(job.seed, -1)).to(job.device)
    points, values = at_most(settings.max_gaussians, start, job.seed)
    look = {"opacity": settings.initial_opacity, "scale": settings.initial_scale}
    first = from_points(points, values, **look, device=job.device)
    first = motion.attach(first, job.training_images)
    supervision = supervise(settings, job.scene).to(job.device)
    trainer = Trainer(job.training_images, first, motion, supervision, settings, scale=job.extent.scale, seed=job.seed)
    trainer.run(job.progress, job.checkpoint, job.key)
    cameras = trainer.poses.cameras(start.cameras)
    return FittedModel(trainer.pieces(), trainer.still, motion, job.scene.duration_us, job.device, spec, cameras)


def at_most(count: int, start: Start, seed: int) -> tuple[Float32, Float32]:
    """The points [N, 3] and gray values [N] of a start, or as many of them as a fit may have, drawn at random."""
    points, values = start.points, start.values
    if len(points) <= count:
        return points, values
    kept = np.sort(np.random.default_rng(seed).choice(len(points), count, replace=False))
    return points[kept], values[kept]


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


def choose_ticks(n_ticks: int, settings: FitSettings) -> tuple[int, ...]:
    """Ticks of the training images: evenly spaced, an edge away from the clip's ends, where windows are cut."""
    edge = min(settings.edge_ticks, (n_ticks - 1) // 2)
    span = n_ticks - 2 * edge
    count = min(settings.max_times, max(1, round(span / settings.time_spacing_ticks) + 1))
    return tuple(sorted({int(t) for t in np.rint(np.linspace(edge, n_ticks - 1 - edge, count))}))


def make_training_images(
    scene: TrainingScene, cameras: Sequence[Camera], images: ImageMaker, settings: FitSettings, device: str
) -> TrainingImages:
    """Images of all training views at the chosen times; see `FitSettings.flat_field`."""
    ticks = choose_ticks(scene.n_ticks, settings)
    gain, cameras_known = scene.radiance_gain, scene.calibrations if settings.flat_field else None
    if cameras_known:
        made = [images(s, ticks, gain, camera) for s, camera in zip(scene.streams, cameras_known, strict=True)]
    else:
        made = [images(s, ticks, gain) for s in scene.streams]
    pictures = np.stack(made, axis=1)
    views = Views.from_cameras(cameras, device=device)
    return TrainingImages(views, ticks, torch.from_numpy(pictures).to(device), scene.n_ticks)


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
