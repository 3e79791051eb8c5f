"""A recipe as a method: images from spikes, first points, the trainer, and a model that renders."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, TypeVar

import torch

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_json
from spike4dgs.benchmark.method import DEFAULT_GIVEN, FitRequest, Model, Recipe, no_progress
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.screen.shown import Shown
from spike4dgs.method.gaussians.density import DensitySettings
from spike4dgs.method.gaussians.parameters import from_points
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.images.light import Light
from spike4dgs.method.images.local_light import light_of
from spike4dgs.method.images.recorded import Recorded, RecordedImages, warm_up_images, without_spikes
from spike4dgs.method.images.training import (
    ImageSettings,
    choose_ticks,
    make_training_images,
    recorded_training_images,
    wanted_images,
)
from spike4dgs.method.models.fitted_model import FittedModel, MotionSpec
from spike4dgs.method.motion.base import Extent, Motion
from spike4dgs.method.pace import at_pace
from spike4dgs.method.pose_refinement import REFINEMENT
from spike4dgs.method.schedule import TrainerSettings
from spike4dgs.method.self_calibration.from_clip import as_in_clip
from spike4dgs.method.self_calibration.shading import with_shadings
from spike4dgs.method.settings import FLAT_FIELD, SettingsByPart, as_dict, follow_images, in_budget, override
from spike4dgs.method.starts.base import Initialization, Start, StartRequest, at_most, learned_facts, measure
from spike4dgs.method.supervision.base import Supervision
from spike4dgs.method.torch_state import check_device, kept_random_state, seeded
from spike4dgs.method.trainer import Trainer
from spike4dgs.method.training_views.pinholes import as_pinholes, with_lenses
from spike4dgs.method.training_views.training_images import TrainingImages
from spike4dgs.method.training_views.warm_up_scene import short, warm_up_scene
from spike4dgs.method.tuned import is_tuned

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class FitJob:
    """Everything that an algorithm fits from and reports to. `key` identifies the fit that a checkpoint belongs to."""

    scene: TrainingScene
    start: Start
    training_images: TrainingImages
    extent: Extent
    settings: Mapping[str, Any]  # by part, step counts scaled by the budget
    request: FitRequest
    key: str
    light: Light | None = None  # what changes in the scene's light

    @property
    def parts(self) -> float:
        """The clip's length in parts of 20 ms that steps follow; a publication's are for the whole clip."""
        return 1.0 if self.request.budget.published else self.extent.parts


@dataclass(frozen=True)
class Algorithm:
    """A fitting loop, the defaults of its parts' settings, its publication's step counts, and what it compares.

    `settings` has the parts that it runs beside the initialisation. `supervisions` names what the loop itself
    implements; empty for the trainer, which takes any of the table.
    """

    label: str | None  # in descriptions of recipes; None: the motion's name
    settings: SettingsByPart
    fit: Callable[[FitJob], Model]
    published: Mapping[str, Any] = field(default_factory=dict)  # overrides of the settings, see `settings.in_budget`
    supervisions: tuple[str, ...] = ()
    calibrated: bool = False  # its loss compares with spikes of the cameras' calibrated response
    shaded: bool = False  # its loss takes the shadings that the clip tells
    rasterizes: bool = True  # renders Gaussians, which on CUDA needs numba-cuda
    refines: bool = True  # its models have `refine`
    layers: bool = False  # it knows `TrainingImages.light`: its gray is the first channel


@dataclass(frozen=True)
class Parts:
    """The tables that a recipe's four names are looked up in. `algorithms` are motions with a loop of their own."""

    images: Mapping[str, ImageMaker]
    initialization: Mapping[str, Initialization]
    motion: Mapping[str, type[Motion]]
    supervision: Mapping[str, type[Supervision]]
    algorithms: Mapping[str, Algorithm] = field(default_factory=dict)


class RecipeMethod(Shown):
    """`benchmark.method.Method` for a recipe whose parts are found in `parts`.

    `params` holds the recipe and all settings by part, overridden or not. Raises UserError for an unknown part or
    setting.
    """

    def __init__(self, recipe: Recipe, parts: Parts, description: str = "") -> None:
        self.name, self.recipe, self.parts = recipe.name, recipe, parts
        self.images = _part(parts.images, recipe, "images")
        self.initialization = _part(parts.initialization, recipe, "initialization")
        _part({**parts.motion, **parts.algorithms}, recipe, "motion")
        self.algorithm = parts.algorithms.get(recipe.motion) or trainer_algorithm(recipe, parts)
        _part(dict.fromkeys(self.algorithm.supervisions) or parts.supervision, recipe, "supervision")
        defaults = {**self.algorithm.settings, "initialization": self.initialization.settings}
        if fields(self.images.settings):
            defaults["image_maker"] = self.images.settings
        found = override(defaults, recipe.settings, f"recipe {recipe.name}")
        self.settings = follow_images(found, recipe.settings)
        if recipe.motion in parts.algorithms and getattr(self.settings["initialization"], "follow_array", False):
            expected, fix = "a motion of the trainer", "leave initialization.follow_array out"
            raise problem(f"recipe {self.name}", expected, recipe.motion, fix)
        self.params: dict[str, Any] = {**recipe.as_dict(), "settings": as_dict(self.settings)}
        self.rasterizes = self.algorithm.rasterizes
        posed = self.initialization.estimates_poses
        self.refines_views = posed and self.algorithm.refines
        if self.refines_views:
            self.params["refinement"] = asdict(REFINEMENT)
        corrected = [getattr(self.settings[part], FLAT_FIELD, False) for part in ("images", "initialization")]
        calibrated = any(corrected) or self.initialization.calibrated or self.algorithm.calibrated
        given = [name for name, used in zip(DEFAULT_GIVEN, (not posed, calibrated), strict=True) if used]
        self.given = (*given, *self.images.given)
        if isinstance(self.images, RecordedImages) and (calibrated or not self.initialization.from_recorded):
            expected, named = "parts that take nothing of spikes", f"{recipe.initialization}, {recipe.supervision}"
            raise problem(f"recipe {self.name}", expected, named, "change them, or the images")
        self.description = description or describe(recipe, parts, self.algorithm)
        weights, self.trained_on = learned_facts(self.images.learned(), self.initialization.networks)
        self.params |= weights
        self._warm: set[str] = set()  # the devices whose kernels are compiled

    def _about(self) -> str:
        return f"{self.name}: {self.description}"

    def maker(self, settings: Mapping[str, Any]) -> ImageMaker:
        """Return the image maker of the recipe's settings."""
        return self.images.with_settings(settings.get("image_maker", self.images.settings))

    def with_settings(self, overrides: Mapping[str, Any], name: str) -> RecipeMethod:
        """Return the same recipe with other settings, by names PART.NAME, under another name.

        Raises UserError for an unknown part or setting, and for a value of another type.
        """
        settings = {**self.recipe.settings, **overrides}
        changed = RecipeMethod(replace(self.recipe, name=name, settings=settings), self.parts, self.description)
        if changed.settings == self.settings:
            fix = "choose another value, or leave it out"
            raise problem(name, "a setting that differs from the recipe's", ", ".join(overrides), fix)
        return changed

    def fit(self, scene: TrainingScene, request: FitRequest) -> Model:
        """Fit the training views, see `benchmark.method.Method`. Raises UserError: a foreign checkpoint, no device."""
        check_device(request.device)
        where, published = f"recipe {self.name}", self.algorithm.published
        settings: dict[str, Any] = in_budget(self.settings, request.budget, published, where)
        request.progress(0, 1, "initialisation")
        recorded = None
        if isinstance(self.images, RecordedImages):
            scene = without_spikes(scene)
            recorded = self.images.read(scene, choose_ticks(scene.n_ticks, settings["images"]))
        scene = as_in_clip(scene, request.seed, poses=not self.initialization.estimates_poses)
        straight, own = as_pinholes(scene), settings["initialization"]
        start = self.initialization.start(StartRequest(straight, request.seed, own, request.device, recorded))
        start = replace(start, cameras=with_lenses(straight, start.cameras))
        if self.algorithm.shaded:
            scene = with_shadings(scene, start)
        return self._fit(scene, start, settings, request, recorded)

    def warm_up(self, request: FitRequest) -> None:
        """Compile what the images, the fit and the rendering of this recipe run, on a made scene; once a process."""
        if request.device in self._warm:
            return
        check_device(request.device)
        request.progress(0, 1, "compilation")
        scene, points, values = warm_up_scene()
        start = Start(scene.cameras, points, values)
        recorded = warm_up_images(scene) if isinstance(self.images, RecordedImages) else None
        quiet = FitRequest(device=request.device, progress=no_progress)
        with kept_random_state(request.device):
            model = self._fit(scene, start, short(self.settings), quiet, recorded)
            model.render(scene.cameras[0], scene.duration_us / 2)
        self._warm.add(request.device)

    def _fit(
        self,
        scene: TrainingScene,
        start: Start,
        settings: Mapping[str, Any],
        request: FitRequest,
        recorded: Recorded | None = None,
    ) -> Model:
        """Fit from given cameras and points, and images of other sensors where the recipe has these."""
        request.progress(0, 1, "images")
        light, pace, algorithm = None, 1.0, self.algorithm
        if recorded:
            images = recorded_training_images(scene, start.cameras, recorded, request.device)
            if len(images.ticks) == 1 and self.recipe.motion not in self.parts.algorithms:
                print(f"{scene.id}: one image of each camera shows no motion: a static model", file=sys.stderr)
                algorithm, settings = self._static(settings)
        else:
            maker = self.maker(settings)
            in_mean_light = maker.knows_light and not algorithm.calibrated  # spikes have the light that there is
            light = light_of(scene, algorithm.layers) if in_mean_light else None

            def make(maker: ImageMaker, settings: ImageSettings) -> TrainingImages:
                return make_training_images(scene, start.cameras, maker, settings, request.device, light)

            images, settings, pace = at_pace(scene.id, maker, settings, make)
        key = sha256_json([scene.revision, self.params, request.budget.label, request.seed])
        count = len(images.ticks) if recorded else wanted_images(scene.n_ticks, settings["images"])
        extent = replace(measure(start, scene), images=count, pace=pace)
        return algorithm.fit(FitJob(scene, start, images, extent, settings, request, key, light))

    def _static(self, settings: Mapping[str, Any]) -> tuple[Algorithm, Mapping[str, Any]]:
        """Return the recipe's algorithm with the motion `static`, and settings with as many steps in all."""
        trainer, algorithm = settings["trainer"], trainer_algorithm(replace(self.recipe, motion="static"), self.parts)
        steps = trainer.coarse_steps + trainer.fine_steps
        own = {"motion": algorithm.settings["motion"], "trainer": replace(trainer, coarse_steps=steps)}
        return algorithm, {**settings, **own}


def describe(recipe: Recipe, parts: Parts, algorithm: Algorithm) -> str:
    """Return one line that says what a recipe is, from its parts' labels."""
    flat = recipe.settings.get("images.flat_field") and recipe.images != "msdi"
    named = (
        (algorithm.label, recipe.motion),
        (parts.images[recipe.images].label, recipe.images),
        (getattr(parts.supervision.get(recipe.supervision), "label", None), recipe.supervision),
        (parts.initialization[recipe.initialization].label, recipe.initialization),
    )
    motion, made, loss, start = (name if label is None else label for label, name in named)
    made = f"images {made}" + (", corrected by calibration" if flat else "")
    searched = "settings by search" if is_tuned(recipe.name) else ""
    return "; ".join(filter(None, (motion, made, loss, start, searched)))


def trainer_algorithm(recipe: Recipe, parts: Parts) -> Algorithm:
    """Return the one trainer, with the recipe's motion and supervision."""
    motion = _part(parts.motion, recipe, "motion")
    supervision = _part(parts.supervision, recipe, "supervision")
    settings = {
        "images": ImageSettings(),
        "motion": motion.defaults,
        "supervision": supervision.defaults,
        "trainer": TrainerSettings(),
        "density": DensitySettings(),
    }

    def fit(job: FitJob) -> FittedModel:
        return fit_gaussians(job, MotionSpec(recipe.motion, job.extent, job.settings["motion"]), motion, supervision)

    found = Algorithm(motion.label, settings, fit, motion.published, layers=motion.image is Motion.image)
    return replace(found, calibrated=supervision.calibrated, shaded=supervision.shaded)


def fit_gaussians(
    job: FitJob, spec: MotionSpec, make_motion: type[Motion], supervise: type[Supervision]
) -> FittedModel:
    """Run the trainer on Gaussians that start at the job's points; return the fitted model."""
    request, start = job.request, job.start
    settings, density = job.settings["trainer"], job.settings["density"]
    motion = make_motion(spec.extent, spec.settings, seeded(request.seed, -1)).to(request.device)
    points, values = at_most(density.max_gaussians, start, request.seed)
    initial = {"opacity": settings.initial_opacity, "scale": settings.initial_scale}
    first = motion.initialize(from_points(points, values, **initial, device=request.device), job.training_images)
    # The cap is of what points become: a motion may lay a point down at several times, which leaves as much room.
    density = replace(density, max_per_pixel=density.max_per_pixel * len(first) / len(points))
    loss = supervise(job.settings["supervision"], job.scene).to(request.device)
    own: Any = {"scale": job.extent.scale, "seed": request.seed, "path": start.path, "parts": job.parts}
    trainer = Trainer(job.training_images, first, motion, loss, settings, density, **own)
    trainer.run(request.progress, request.checkpoint, job.key)
    return FittedModel(
        pieces=trainer.pieces(),
        background=trainer.background,
        motion=motion,
        duration_us=job.scene.duration_us,
        device=request.device,
        spec=spec,
        cameras=trainer.poses.cameras(start.cameras),
        pixel_filter=settings.pixel_filter,
        estimates=trainer.supervision.estimates(),
        light=None if job.light is None else torch.tensor(job.light.factors, dtype=torch.float32),
        path=start.path,
    )


def _part(table: Mapping[str, T], recipe: Recipe, part: str) -> T:
    """Return the entry that a recipe names for a part. Raises UserError with the table's names."""
    name = getattr(recipe, part)
    if name not in table:
        raise problem(f"recipe {recipe.name}", f"{part} among {', '.join(sorted(table))}", repr(name), "correct it")
    return table[name]
