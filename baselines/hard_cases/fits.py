"""Fits of streams that hold nothing, everything, the same thing, or too little: everything has to stay finite."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import safetensors.numpy

from spike4dgs.baselines.hard_cases.images import stream_of
from spike4dgs.baselines.recipes import PARTS
from spike4dgs.benchmark.environment import harness, utc_now
from spike4dgs.benchmark.hard_cases.case import Case, Outcome, Setting, refused
from spike4dgs.benchmark.method import FitRequest, Recipe
from spike4dgs.benchmark.runs.provenance import Provenance
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.self_calibration.clocks import estimate_clocks
from spike4dgs.method.starts.base import Initialization, Start
from spike4dgs.method.training_views.warm_up_scene import warm_up_scene

_FEW: dict[str, Any] = {
    "trainer.coarse_steps": 4,
    "trainer.fine_steps": 8,
    "trainer.piece_steps": 3,
    "trainer.views_per_step": 2,
    "density.refine_every": 3,
    "images.time_spacing_ticks": 20,
    "images.max_times": 4,
    "images.flat_field": True,
}
_FROZEN = {"trainer.freeze_background": True}
RECIPES = {
    "pixel": Recipe("pixel", "intervals", "made", "paths", "pixel", {**_FEW, **_FROZEN}),
    "spss": Recipe("spss", "tfp", "made", "hexplane", "spss", {**_FEW, "motion.mlp_width": 8, "motion.features": 4}),
    "pixel+spike": Recipe("pixel+spike", "tfi", "made", "spacetime", "pixel+spike", _FEW),
}  # fmt: skip


def _with_spikes(make: Callable[[np.random.Generator, tuple[int, int, int]], Any], views: int | None = None) -> Any:
    """Return a function that puts spikes into the first `views` cameras of the made scene, or into all of them."""

    def scene(rng: np.random.Generator) -> TrainingScene:
        usual = warm_up_scene()[0]
        stream = usual.streams[0]
        spikes = np.asarray(make(rng, (usual.n_ticks, stream.height, stream.width)), np.uint8)
        count = len(usual.streams) if views is None else views
        streams = (stream_of(spikes),) * count + usual.streams[count:]
        return replace(usual, streams=streams, n_ticks=len(spikes))

    return scene


def _one_view(rng: np.random.Generator) -> TrainingScene:
    usual = warm_up_scene()[0]
    return replace(usual, cameras=usual.cameras[:1], streams=usual.streams[:1], recordings=usual.recordings[:1])


SCENES: dict[str, tuple[str, Callable[[np.random.Generator], TrainingScene]]] = {
    "dark": ("streams without a spike", _with_spikes(lambda rng, shape: np.zeros(shape))),
    "saturated": ("a spike in every tick of every pixel", _with_spikes(lambda rng, shape: np.ones(shape))),
    "still": ("the same in every tick", _with_spikes(lambda rng, s: np.tile(rng.random(s[1:]) < 0.5, (s[0], 1, 1)))),
    "blinded": ("one saturated camera among good ones", _with_spikes(lambda rng, shape: np.ones(shape), 1)),
    "short": ("a clip of one tick", _with_spikes(lambda rng, shape: rng.random((1, *shape[1:])) < 0.5)),
    "long": ("20,000 ticks", _with_spikes(lambda rng, s: np.tile(rng.random((100, *s[1:])) < 0.3, (200, 1, 1)))),
    "one-view": ("one training view", _one_view),
}  # fmt: skip


def cases() -> list[Case]:
    """Return the cases of fits, and of clocks that nothing tells."""
    return [
        *(_fit_case(recipe, name) for name in SCENES for recipe in RECIPES),
        Case(id="baselines/clocks/refuse", asked="clocks from two cameras, and from a clip of 40 ticks",
             twin="the contract: one clear error each", unit="inputs taken", tolerance=0, run=_refused_clocks),
        Case(id="baselines/clocks/still", asked="clocks of an array that sees nothing, and one that is saturated",
             twin="standard errors above 2 ticks: nothing is known", unit="cameras too sure", tolerance=0,
             run=_unsure_clocks),
    ]  # fmt: skip


def _fit_case(recipe: str, name: str) -> Case:
    r = RECIPES[recipe]

    def run(setting: Setting) -> Outcome:
        return _fitted(r, SCENES[name][1](setting.rng()), setting)

    return Case(
        id=f"baselines/fit/{name}-{recipe}",
        asked=f"fit: {SCENES[name][0]} ({r.images}, {r.motion}, {r.supervision}), 12 steps",
        twin="finite losses, parameters and images",
        unit="values that are not finite",
        tolerance=0,
        run=run,
        on_device=True,
        seconds=0.6,
    )


def _fitted(recipe: Recipe, scene: TrainingScene, setting: Setting) -> Outcome:
    """Fit, save, render; count what is not finite in the losses, the model's tensors and the images."""
    notes: list[str] = []
    start = Initialization(lambda request: Start(request.scene.cameras, *warm_up_scene()[1:]))
    method = RecipeMethod(recipe, replace(PARTS, initialization={"made": start}))
    request = FitRequest(
        seed=setting.seed, device=setting.device, progress=lambda done, total, note="": notes.append(note)
    )
    model: Any = method.fit(scene, request)
    path = setting.folder / "model.safetensors"
    model.save(path, _provenance(scene, setting))
    tensors = safetensors.numpy.load_file(path)
    images = [model.render(scene.cameras[0], t) for t in (0.0, scene.duration_us / 2, scene.duration_us)]
    losses = [note for note in notes if note.startswith("loss")]
    numbers = [*(v for v in tensors.values() if np.issubdtype(v.dtype, np.floating)), *images]
    bad = sum(int((~np.isfinite(v)).sum()) for v in numbers) + sum("nan" in t or "inf" in t for t in losses)
    shown = np.stack(images)
    text = f"{losses[-1] if losses else 'no loss'}; images from {np.nanmin(shown):.3g} to {np.nanmax(shown):.3g}"
    return Outcome(text, float(bad), not bad)


def _provenance(scene: TrainingScene, setting: Setting) -> Provenance:
    method = {"name": "hard-cases", "version": "0", "params": {}, "seed": setting.seed, "trained_on": []}
    return Provenance(
        method, scene.id, "0" * 64, "none", scene.cameras, scene.rate_hz, scene.n_ticks, scene.radiance_gain, 1.0,
        setting.device, 0.0, harness(), utc_now(),
    )  # fmt: skip


def _refused_clocks(setting: Setting) -> Outcome:
    usual = warm_up_scene()[0]
    two = replace(usual, cameras=usual.cameras[:2], streams=usual.streams[:2], recordings=usual.recordings[:2])
    short = _with_spikes(lambda rng, shape: rng.random((40, *shape[1:])) < 0.5)(setting.rng())
    return refused({"two cameras": lambda: estimate_clocks(two), "40 ticks": lambda: estimate_clocks(short)})


def _unsure_clocks(setting: Setting) -> Outcome:
    sure, errors = 0, []
    for level in (0.0, 1.0):
        scene = _with_spikes(lambda rng, shape, level=level: np.full((240, *shape[1:]), level))(setting.rng())  # type: ignore[misc]
        found = estimate_clocks(scene).cameras.values()
        errors += [e.error_ticks for e in found]
        sure += sum(not (e.error_ticks > 2 and np.isfinite(e.clock.offset_ticks)) for e in found)
    return Outcome(f"standard errors from {min(errors):.3g} ticks", float(sure), bool(np.isfinite(errors).all()))
