"""Oracles: a recipe with one thing replaced by the truth, or one limit removed. They say where a method loses its dB.

An oracle is a recipe whose parts come from other tables: one image maker, one initialisation or one motion is replaced
by one that reads the truth of a folder. Nothing that fits knows of it, no oracle is an installed method, and every
record of one is marked. `report oracle-ladder` makes the folder and hands it in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from spike4dgs.baselines.recipes import PARTS
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import unknown
from spike4dgs.benchmark.method import FitRequest, Method, Model, find_methods
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.images.training import choose_ticks
from spike4dgs.method.motion.base import Motion
from spike4dgs.method.motion.paths import Paths
from spike4dgs.method.settings import FLAT_FIELD
from spike4dgs.method.starts.base import Initialization, Start, StartRequest
from spike4dgs.method.starts.clip import window_means
from spike4dgs.method.starts.rig import Cloud, CloudSettings, cells_of, filled
from spike4dgs.method.training_views.training_images import TrainingImages
from spike4dgs.studies.oracle_truth import Surfaces, Truth

DEFAULT = "spike4dgs-x"
MORE_STEPS = 4.0  # as --budget standard
TITLES = {
    "images": "true images",
    "points": "true first points",
    "velocities": "true first velocities",
    "calibration": "true calibration",
    "gaussians": "more Gaussians",
    "steps": f"{MORE_STEPS:g} x steps",
}
RUNGS = (*((name,) for name in TITLES), ("images", "gaussians", "steps"))
_NO_LIMIT: dict[str, Any] = {"density.max_moving_per_pixel": 1e3, "density.max_gaussians": 10_000_000}


@dataclass(frozen=True, eq=False)
class Rung:
    """A fit of a ladder, and what is said of it."""

    title: str
    method: Method


@dataclass(frozen=True, eq=False)
class Ladder:
    """The fits of a method: first the method as it is."""

    method: str
    rungs: tuple[Rung, ...]
    image_ticks: Callable[[int], Sequence[int]]  # length of a clip -> the ticks whose images the fits compare with
    left_out: tuple[str, ...] = ()  # rungs that the method has no use for, with the reason


class OracleMethod:
    """The recipe `base` with what `replaced` names of `TITLES` replaced; `benchmark.method.Method`.

    `root` is the folder of truths, `samples` the number that its images have: both are handed in by who made them. It
    holds plain values alone, so that it travels to workers.
    """

    def __init__(self, base: str, replaced: Sequence[str], root: Path, samples: int) -> None:
        self.base, self.oracle, self.root, self.samples = base, tuple(replaced), root.absolute(), samples
        self.name = f"{base}+oracle-{'-'.join(replaced)}"
        found = RecipeMethod(self._recipe, PARTS)
        given: dict[str, Any] = {"base": base, "replaced": list(replaced)}
        given |= {"samples": samples} if {"images", "points"} & set(replaced) else {}
        given |= {"steps": MORE_STEPS} if "steps" in replaced else {}
        self.params: dict[str, Any] = {**found.params, "oracle": given}
        self.given, self.trained_on = _recipe_method(base).given, found.trained_on

    @property
    def _recipe(self) -> Any:
        """The recipe under the oracle's name, with the settings that it changes."""
        recipe = _recipe_method(self.base).recipe
        settings = dict(recipe.settings)
        if "gaussians" in self.oracle:
            # Without a background nothing tells the Gaussians that move from the others: all may become more.
            everywhere = {} if settings.get("trainer.freeze_background") else {"density.max_per_pixel": 1e3}
            settings |= {**_NO_LIMIT, **everywhere}
        if "calibration" in self.oracle:
            settings[f"images.{FLAT_FIELD}"] = True
        if "images" in self.oracle:  # which have no numbers of their maker
            settings = {k: v for k, v in settings.items() if not k.startswith("image_maker.")}
        return replace(recipe, name=self.name, settings=settings)

    def fit(self, scene: TrainingScene, request: FitRequest) -> Model:
        """Fit the training views and the truth of this scene and revision, which must be in the folder."""
        truth = Truth.of(self.root, scene.id, scene.revision, self.samples)
        if "calibration" in self.oracle:
            scene = replace(scene, known_calibrations=truth.calibrations(scene.radiance_gain))
        recipe, parts = self._recipe, PARTS
        if "images" in self.oracle:
            true = TrueImages(truth=truth, streams=scene.streams)
            parts = replace(parts, images={**parts.images, recipe.images: true})
        if "points" in self.oracle:
            own = parts.initialization[recipe.initialization]
            start = Initialization(partial(true_points, truth.surfaces()), own.settings)
            parts = replace(parts, initialization={**parts.initialization, recipe.initialization: start})
        if "velocities" in self.oracle:
            moved = paths_that_know(nearest_velocities(truth.surfaces()), scene.n_ticks / scene.rate_hz)
            parts = replace(parts, motion={**parts.motion, recipe.motion: moved})
        if "steps" in self.oracle:
            request = replace(request, budget=replace(request.budget, scale=MORE_STEPS * request.budget.scale))
        return RecipeMethod(recipe, parts).fit(scene, request)

    def warm_up(self, request: FitRequest) -> None:
        """Compile what the recipe runs."""
        _recipe_method(self.base).warm_up(request)


def oracle_ladders(names: Sequence[str], truth: Path, samples: int) -> tuple[Ladder, ...]:
    """Return the ladder of each named recipe, of `spike4dgs-x` without names; `truth` is the folder of the truths.

    Raises UserError for what is no recipe of the one trainer with given poses.
    """
    return tuple(_ladder(name, truth, samples) for name in dict.fromkeys(names or (DEFAULT,)))


def _ladder(name: str, truth: Path, samples: int) -> Ladder:
    method = _recipe_method(name)
    follows = issubclass(PARTS.motion[method.recipe.motion], Paths)
    chosen = [replaced for replaced in RUNGS if follows or "velocities" not in replaced]
    left_out = () if follows else (f"{TITLES['velocities']}: the motion {method.recipe.motion} starts without any",)
    oracles = [OracleMethod(name, replaced, truth, samples) for replaced in chosen]
    rungs = [Rung(", ".join(TITLES[part] for part in oracle.oracle), oracle) for oracle in oracles]
    settings: Any = method.settings["images"]
    return Ladder(name, (Rung("as it is", method), *rungs), lambda n_ticks: choose_ticks(n_ticks, settings), left_out)


@cache  # an oracle asks for it several times, and packages are looked through each time
def _recipe_method(name: str) -> RecipeMethod:
    """Return the method of a recipe. Raises UserError where it has no oracles."""
    known = {
        name: method
        for name, method in find_methods().items()
        if isinstance(method, RecipeMethod)
        and not method.initialization.estimates_poses
        and method.recipe.motion not in PARTS.algorithms
    }
    if name not in known:
        raise unknown("--methods", name, sorted(known))
    return known[name]


# ---------------------------------------------------------------- what an oracle puts in the place of a part


@dataclass(frozen=True, eq=False, kw_only=True)
class TrueImages(ImageMaker):
    """True images in the place of those from spikes, of the given streams alone."""

    name: str = "truth"

    truth: Truth
    streams: tuple[SpikeStream, ...]  # of the training cameras, in the order of the truth's

    def __call__(
        self, stream: SpikeStream, ticks: Sequence[int], gain: float, camera: Calibration | None = None
    ) -> Float32:
        """Return linear radiance [n, H, W] at `ticks`; gain and calibration are no concern of the truth's."""
        view = next(i for i, own in enumerate(self.streams) if own is stream)
        return self._images(tuple(ticks))[:, view]

    def _images(self, ticks: tuple[int, ...]) -> Float32:
        """Return the images [T, C, H, W], which all views ask for at the same ticks."""
        if ticks not in self._read:
            self._read[ticks] = self.truth.images(ticks)
        return self._read[ticks]

    @cached_property
    def _read(self) -> dict[tuple[int, ...], Float32]:
        return {}


def true_points(surfaces: Surfaces, request: StartRequest) -> Start:
    """Return the given poses and true points, as dense as those of `rig`, and as filled where no surface is."""
    own, cameras = request.settings, request.scene.cameras
    settings = own if isinstance(own, CloudSettings) else CloudSettings()
    cloud = one_per_cell(cameras, surfaces, settings)
    mean = window_means(request.scene, 0, request.scene.n_ticks, bool(getattr(own, FLAT_FIELD, False)))
    return filled(request.scene, cloud, mean, settings)


def one_per_cell(cameras: Sequence[Any], surfaces: Surfaces, settings: CloudSettings) -> Cloud:
    """Return one of the points of each cell of `rig.thin`: the mean of several would leave their surface."""
    keep, cells = cells_of(cameras, points := surfaces.points.astype(np.float64), settings)
    _, first = np.unique(cells, axis=0, return_index=True)
    chosen = np.flatnonzero(keep)[np.sort(first)]
    return Cloud(points[chosen], surfaces.values[chosen])


def nearest_velocities(surfaces: Surfaces) -> Callable[[NDArray[Any]], Float32]:
    """Return a function from points [N, 3] m to the velocities [N, 3] m/s of the surfaces nearest to them."""
    tree = cKDTree(surfaces.points)
    return lambda points: surfaces.velocities[tree.query(points)[1]]


def paths_that_know(velocities: Callable[[NDArray[Any]], Float32], duration_s: float) -> type[Motion]:
    """Return the motion `paths` whose first Gaussians move as `velocities` says, which is of the middle of the clip."""

    class KnowingPaths(Paths):
        def initialize(self, gaussians: Gaussians, images: TrainingImages) -> Gaussians:
            first = super().initialize(gaussians, images)
            found = torch.from_numpy(velocities(first.means.detach().cpu().numpy()))
            first.extra["coefficients"][:, :3] = found.to(first.means) * (duration_s / self.pieces)
            return first

        def set_off(self, gaussians: Gaussians, images: TrainingImages) -> Gaussians:
            return gaussians

    return KnowingPaths
