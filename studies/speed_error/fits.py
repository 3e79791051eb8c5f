"""Fits of one scene with less, or more, than a recipe uses: steps, Gaussians, what is frozen, pieces, widths.

A fit has no exact twin. The one without the limit stands in for it, and errors are against the scene's ground truth at
the held-out camera: where the chosen point's error is that of the unlimited fit, the limit costs nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from spike4dgs.baselines.recipes import METHODS, PARTS
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.environment import peak_memory_mb, reset_peak_memory
from spike4dgs.benchmark.method import Budget, FitRequest, Recipe, no_progress, training_for
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.gaussians.density import DensitySettings
from spike4dgs.method.models.fitted_model import FittedModel
from spike4dgs.method.motion.paths import Paths
from spike4dgs.method.recipes import SPIKE4DGS_X
from spike4dgs.studies.kit.measurement import Column, Point, Request, Series, measurement
from spike4dgs.studies.speed_error.images import MOVING, rms_errors

GROUP = "Fits"
_COLUMNS = (
    Column("seconds", "fit, s"),
    *MOVING,
    Column("psnr", "PSNR, dB", log=False),
    Column("gaussians", "Gaussians"),
    Column("memory", "peak memory, MB"),
    Column("render", "an image, ms"),
)


@dataclass(frozen=True)
class Trial:
    """A fit: settings that a recipe overrides, a multiple of the size's steps, and the pieces of the clip."""

    name: str
    settings: Mapping[str, Any]
    scale: float = 1.0
    pieces: int | None = None
    role: Any = ""


def fitted(recipe: Recipe, trial: Trial, scene: Scene, request: Request, warm_up: bool) -> Point:
    """Return the point of one fit. With `warm_up` its kernels are compiled first."""
    parts = PARTS if trial.pieces is None else replace(PARTS, motion={**PARTS.motion, "paths": cut_in(trial.pieces)})
    changed = replace(recipe, settings={**recipe.settings, **trial.settings})
    method = RecipeMethod(changed, parts)
    fit = FitRequest(Budget(trial.scale), request.device, request.seed, no_progress)
    if warm_up:
        method.warm_up(fit)
    reset_peak_memory(request.device)
    start = time.perf_counter()
    model = method.fit(training_for(method, scene.training), fit)
    assert isinstance(model, FittedModel)
    seconds, memory = time.perf_counter() - start, peak_memory_mb(request.device)
    rendered = []

    def image(scene: Scene, target: Target) -> Float32:
        start = time.perf_counter()
        found = model.render(scene.cameras[target.camera], target.tick * 1e6 / scene.rate_hz)
        rendered.append(1e3 * (time.perf_counter() - start))
        return found

    rms = rms_errors(scene, scene.targets, image)
    count = len(model.splats(scene.n_ticks * 0.5e6 / scene.rate_hz))
    values = {"seconds": seconds, "memory": memory, "gaussians": count, "render": float(np.median(rendered)), **rms}
    return Point(trial.name, {**values, "psnr": -20 * math.log10(rms["rms"] or math.nan)}, trial.role)


def cut_in(pieces: int) -> type[Paths]:
    """Return the motion `paths`, with this many pieces whatever the clip's length."""

    class Cut(Paths):
        @property
        def pieces(self) -> int:
            return pieces

    return Cut


def _series(request: Request, recipe: Recipe, trials: tuple[Trial, ...]) -> Iterator[Series]:
    scene = open_scene(request.scene())
    points = tuple(fitted(recipe, trial, scene, request, i == 0) for i, trial in enumerate(trials))
    yield Series(f"{recipe.name} on {scene.id}", points)


def _steps(request: Request) -> float:
    """Return the multiple of the quick budget's steps that a size affords."""
    return float(request.pick(0.004, 0.15, 1.0))


@measurement("budget", GROUP, "Budget: steps of a fit", _COLUMNS, ("rms", "moving"), (24.0, 72.0, 660.0))
def budgets(request: Request) -> Iterator[Series]:
    """The budget `quick` stops after 600 static and 1200 moving steps. The sizes tiny and quick of this report take a
    share of it.

    Four times the steps, the budget `standard` (three times in the size quick).

    `quick` is what fits in 90 s on two cores at 200x125 pixels and 20 ms.

    tests/studies/speed_error/test_fits.py
    """
    shares = {0.1: "", 0.3: "", 1.0: "chosen", request.pick(2.0, 3.0, 4.0): "exact"}
    trials = tuple(Trial(f"{s:g} x quick", {}, s * _steps(request), role=role) for s, role in shares.items())
    yield from _series(request, SPIKE4DGS_X, trials)


@measurement("cap", GROUP, "Gaussians: their largest number", _COLUMNS, ("rms", "moving"), (None, 48.0, 440.0))
def caps(request: Request) -> Iterator[Series]:
    """Density control stops at 0.8 Gaussians a pixel of a view, at 0.4 of those that move, and at 36,000.

    No limit that a fit reaches.

    Each Gaussian costs time in every step and every image. Half a Gaussian a pixel saved a fifth of the time for 0.6 dB
    when the limit was chosen.

    tests/studies/speed_error/test_fits.py
    """
    usual, own = DensitySettings(), SPIKE4DGS_X.settings
    trials = []
    for factor, role in ((1 / 16, ""), (1 / 4, ""), (1.0, "chosen"), (100.0, "exact")):
        limits = {
            "density.max_per_pixel": factor * usual.max_per_pixel,
            "density.max_moving_per_pixel": factor * own["density.max_moving_per_pixel"],
            "density.max_gaussians": own["density.max_gaussians"] if factor <= 1 else usual.max_gaussians,
        }
        name = f"{factor * usual.max_per_pixel:g} a pixel" if factor <= 1 else "no limit"
        trials.append(Trial(name, limits, _steps(request), role=role))
    yield from _series(request, SPIKE4DGS_X, tuple(trials))


@measurement(
    "freezing", GROUP, "Background: frozen after the static stage", _COLUMNS, ("rms", "moving"), (None, 60.0, 550.0)
)
def freezing(request: Request) -> Iterator[Series]:
    """Gaussians where nothing changes become a background, which no later step deforms or differentiates.

    All Gaussians are fitted to the end.

    0.012 is above the noise of static pixels and below the change of moving ones. A limit too high freezes what moves,
    which costs most where it moves.

    tests/studies/speed_error/test_fits.py
    """
    limits = {"0.006": 0.006, "0.012": 0.012, "0.024": 0.024, "0.1": 0.1}
    on = [
        Trial(f"moves above {name}", {"trainer.moving_change": v}, _steps(request), role="chosen" if v == 0.012 else "")
        for name, v in limits.items()
    ]
    off = Trial("nothing frozen", {"trainer.freeze_background": False}, _steps(request), role="exact")
    yield from _series(request, SPIKE4DGS_X, (*on, off))


@measurement("pieces", GROUP, "Pieces of the clip", _COLUMNS, ("rms", "moving"), (None, 36.0, 330.0))
def pieces(request: Request) -> Iterator[Series]:
    """Each 20 ms of a clip have Gaussians of their own, whose paths are cubics.

    More pieces: each follows a shorter part of the motion.

    One piece is what clips of 20 ms have. More pieces fit more steps and Gaussians for the same clip; they pay only in
    longer clips.

    tests/studies/speed_error/test_fits.py
    """
    roles = {1: "chosen", 3: "", 5: "exact"}
    trials = (Trial(f"{n} piece{'s' if n > 1 else ''}", {}, _steps(request), n, role) for n, role in roles.items())
    yield from _series(request, SPIKE4DGS_X, tuple(trials))


@measurement("hexplane", GROUP, "HexPlane: width and features", _COLUMNS, ("rms", "moving"), (None, 72.0, 660.0))
def widths(request: Request) -> Iterator[Series]:
    """The deformation network has 32 units a layer and 16 features a plane.

    128 units, as published; or 32 features.

    32 units took 0.4 of the time of 64 when they were chosen; 16 features are 4DGS's own. Both cost time at every
    Gaussian of every step.

    tests/studies/speed_error/test_fits.py
    """
    recipe: Recipe = METHODS["tfp+4dgs"].recipe  # type: ignore[attr-defined]
    for setting, values, chosen in (("mlp_width", (8, 32, 128), 32), ("features", (4, 16, 32), 16)):
        roles = {v: "chosen" if v == chosen else "exact" if v == values[-1] else "" for v in values}
        trials = (Trial(f"{setting} {v}", {f"motion.{setting}": v}, _steps(request), role=roles[v]) for v in values)
        for s in _series(request, recipe, tuple(trials)):
            yield Series(f"{s.name}, {setting}", s.points)


FITS = (budgets, caps, freezing, pieces, widths)
