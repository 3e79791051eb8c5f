"""Fits that stop and go on, fits of other seeds and threads, saved models: equal bit for bit, or by how much not."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.environment import harness, utc_now
from spike4dgs.benchmark.hard_cases.case import Case, Outcome, Setting, compare
from spike4dgs.benchmark.hard_cases.cores import core_counts, equal_bytes
from spike4dgs.benchmark.method import FitRequest, Recipe
from spike4dgs.benchmark.runs.provenance import Provenance
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.fit import Parts, RecipeMethod, measure
from spike4dgs.method.gaussians.density import DensitySettings
from spike4dgs.method.gaussians.parameters import from_points
from spike4dgs.method.hard_cases.splat import differentiate
from spike4dgs.method.hard_cases.splat_scenes import random_splats, views
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.images.training import ImageSettings, make_training_images
from spike4dgs.method.models.fitted_model import FittedModel, MotionSpec
from spike4dgs.method.models.saved_model import load_model
from spike4dgs.method.motion.table import MOTIONS
from spike4dgs.method.schedule import TrainerSettings
from spike4dgs.method.splat import set_threads
from spike4dgs.method.splat.kernels.threads import get_threads
from spike4dgs.method.splat.ssim import ssim
from spike4dgs.method.starts.base import Initialization, Start
from spike4dgs.method.supervision.table import SUPERVISIONS
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.trainer import Trainer
from spike4dgs.method.training_views.warm_up_scene import radiance_of, warm_up_scene

STOPS = (10, 20, 30)  # steps after which a fit is interrupted
_STEPS = TrainerSettings(coarse_steps=15, fine_steps=25, piece_steps=10, views_per_step=3)
_SMALL = {"hexplane": {"mlp_width": 16, "features": 4}}
# What has a state of its own: motion networks, parameters of each Gaussian, a loss's own, a frozen background.
FITS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "hexplane": ("hexplane", "spss", {}),
    "spacetime": ("spacetime", "spike-render", {}),
    "paths-background": ("paths", "pixel", {"freeze_background": True}),
}
_SEEDS = 3  # other seeds
_PSNR_STEPS = {"trainer.coarse_steps": 60, "trainer.fine_steps": 240, "trainer.views_per_step": 2}


def silent(done: int, total: int, note: str = "") -> None:
    """Hear about progress and say nothing."""


def window_mean(stream: SpikeStream, tick: int, settings: object) -> Float32:
    """Return the mean of the spikes 12 ticks around a tick [H, W]."""
    a, b = max(0, tick - 12), min(stream.n_ticks, tick + 12)
    return (stream.counts(a, b) / (b - a)).astype(np.float32)


MEAN = ImageMaker(name="mean", rate=window_mean)


def start_of(scene: TrainingScene) -> Start:
    """Return a start on the made scene's wall."""
    return Start(scene.cameras, *warm_up_scene()[1:])


def small_trainer(motion: str, supervision: str, seed: int, extra: Mapping[str, Any], device: str) -> Trainer:
    """Return a trainer of few steps on the made scene, densification included."""
    scene = warm_up_scene()[0]
    start, s = start_of(scene), replace(_STEPS, **extra)
    images = make_training_images(scene, start.cameras, MEAN, ImageSettings(time_spacing_ticks=20), device)
    kind, loss = MOTIONS[motion], SUPERVISIONS[supervision]
    settings = replace(kind.defaults, **_SMALL.get(motion, {}))
    extent = measure(start, scene)
    model = kind(extent, settings, seeded(seed, -1)).to(device)
    gaussians = model.initialize(from_points(start.points, start.values, opacity=0.5, device=device), images)
    compare_with = loss(loss.defaults, scene).to(device)
    density = DensitySettings(refine_every=4)
    return Trainer(images, gaussians, model, compare_with, s, density, scale=extent.scale, seed=seed)


def state_bytes(trainer: Trainer) -> bytes:
    """Return everything that later steps of a fit depend on, as bytes."""
    tensors = trainer.state().tensors
    return b"".join(_bytes(tensors[name]) for name in sorted(tensors))


def _bytes(tensor: Tensor) -> bytes:
    return tensor.detach().cpu().contiguous().numpy().tobytes()


def cases() -> list[Case]:
    """Return the cases of fits and saved models."""
    return [*map(_resumed_case, FITS), *_threads_cases(), *_seed_cases(), *map(_saved_case, MOTIONS)]


class _Stopped(Exception):
    pass


def _resumed_case(name: str) -> Case:
    def run(setting: Setting) -> Outcome:
        motion, supervision, extra = FITS[name]

        def new() -> Trainer:
            return small_trainer(motion, supervision, setting.seed, extra, setting.device)

        whole = new()
        whole.run(silent)
        results = [state_bytes(whole)]
        for stop in STOPS:
            path = setting.folder / f"{stop}.safetensors"

            def stops(done: int, total: int, note: str = "", stop: int = stop) -> None:
                if done >= stop:
                    raise _Stopped

            first, second = new(), new()
            with suppress(_Stopped):
                first.run(stops, path, "fit", checkpoint_s=0)
            if not 0 < first.step < first.total:
                return Outcome(f"the fit was not stopped after {stop} steps", np.inf)
            second.run(silent, path, "fit")
            results.append(state_bytes(second))
        names = ["not stopped", *(f"stopped after {n} steps" for n in STOPS)]
        return equal_bytes(results, names)

    return Case(
        id=f"method/fit/resume-{name}",
        asked=f"a fit ({', '.join(FITS[name][:2])}) interrupted at a checkpoint and resumed",
        twin="the fit that never stopped",
        unit="bytes that differ",
        tolerance=0,
        run=run,
        kind="resume",
        on_device=True,
        seconds=4,
    )


def _threads_cases() -> list[Case]:
    shared: dict[str, Any] = {
        "twin": "one thread",
        "unit": "bytes that differ",
        "tolerance": 0,
        "kind": "threads",
        "seconds": 1.5,
    }
    counts = ", ".join(map(str, thread_counts()))
    return [
        Case(id="method/splat/threads", asked=f"render and differentiate 3,000 Gaussians on {counts} threads",
             run=lambda s: _by_threads(_rendered), **shared),
        Case(id="method/loss/ssim-threads", asked=f"SSIM of training and its gradient on {counts} threads",
             run=lambda s: _by_threads(_ssim_bytes), **shared),
        Case(id="method/fit/threads", asked=f"a whole fit (hexplane, spss) on {counts} threads",
             run=lambda s: _by_threads(lambda: _fit_bytes("hexplane", "spss", s.seed)), **shared),
    ]  # fmt: skip


def thread_counts() -> list[int]:
    """Return the numbers of threads to try: those of `core_counts`, and one more than there are cores."""
    counts = core_counts()
    return [*counts, counts[-1] + 1]


def _by_threads(compute: Callable[[], bytes]) -> Outcome:
    before, results = get_threads(), []
    try:
        for count in thread_counts():
            set_threads(count)
            results.append(compute())
    finally:
        set_threads(before)
    return equal_bytes(results, [f"{n} threads" for n in thread_counts()])


def _rendered() -> bytes:
    splats, v = random_splats(3000, seed=23), views()
    out, gradients = differentiate(splats, v, "cpu", torch.ones(2, v.height, v.width), True)
    assert out.depth is not None
    return b"".join(map(_bytes, (out.image, out.alpha, out.depth, out.radii, *gradients.values())))


def _ssim_bytes() -> bytes:
    g = torch.Generator().manual_seed(1)
    a, b = torch.rand(5, 50, 60, generator=g).requires_grad_(), torch.rand(5, 50, 60, generator=g)
    value = ssim(a, b)
    value.backward()  # type: ignore[no-untyped-call]
    assert a.grad is not None
    return _bytes(value) + _bytes(a.grad)


def _fit_bytes(motion: str, supervision: str, seed: int) -> bytes:
    trainer = small_trainer(motion, supervision, seed, {}, "cpu")
    trainer.run(silent)
    return state_bytes(trainer)


def _seed_cases() -> list[Case]:
    return [
        Case(
            id="method/fit/same-seed",
            asked="fit the made scene twice with one seed (paths, pixel)",
            twin="the first of the two fits",
            unit="bytes that differ",
            tolerance=0,
            run=lambda s: equal_bytes(
                [_fit_bytes("paths", "pixel", s.seed) for _ in range(2)], ["the first fit", "the second"]
            ),
            kind="seeds",
            seconds=2,
        ),
        Case(
            id="method/fit/other-seeds",
            asked=f"PSNR of an unseen camera, {_SEEDS} seeds, 300 steps (paths, pixel)",
            twin="the other seeds: the spread of the result",
            unit="dB",
            tolerance=3.0,  # after so few steps; whole fits of the tests stay within 0.3 dB
            run=_other_seeds,
            kind="seeds",
            on_device=True,
            seconds=8,
        ),
    ]


def _other_seeds(setting: Setting) -> Outcome:
    scene = warm_up_scene()[0]
    held_out = replace(scene.cameras[0], id="held out", t=-scene.cameras[0].R @ np.array([0.05, 0.02, 0.0]))
    truth = radiance_of(held_out)
    parts = Parts({"mean": MEAN}, {"made": Initialization(lambda r: start_of(r.scene))}, MOTIONS, SUPERVISIONS)
    recipe = Recipe("hard-cases", "mean", "made", "paths", "pixel", _PSNR_STEPS)
    scores, images = [], set()
    for seed in range(setting.seed, setting.seed + _SEEDS):
        request = FitRequest(seed=seed, progress=silent, device=setting.device)
        model = RecipeMethod(recipe, parts).fit(scene, request)
        image = model.render(held_out, scene.duration_us / 2)
        images.add(hashlib.sha256(image.tobytes()).hexdigest())
        scores.append(-10 * np.log10(np.mean((image - truth[len(truth) // 2]) ** 2)))
    text = ", ".join(f"{score:.2f}" for score in scores)
    if len(images) < _SEEDS:
        return Outcome(f"{text} dB; two seeds gave the same image", np.inf)
    return Outcome(f"{text} dB; mean {np.mean(scores):.2f}", float(np.ptp(scores)), bool(np.isfinite(scores).all()))


def _saved_case(motion: str) -> Case:
    def run(setting: Setting) -> Outcome:
        model = _moving_model(motion)
        path, camera = setting.folder / "model.safetensors", warm_up_scene()[0].cameras[0]
        model.save(path, _provenance())
        loaded = load_model(path).model
        times = (-10.0, 0.0, 0.37 * model.duration_us, model.duration_us, 1e9)
        pairs = [np.stack([m.render(camera, t) for t in times]) for m in (loaded, model)]
        return compare(*pairs)

    return Case(
        id=f"method/saved/{motion}",
        asked=f"save and load a model ({motion}); render it before, in and after the clip",
        twin="the model that was saved",
        unit="of white",
        tolerance=0,
        run=run,
        seconds=1,
    )


@cache
def _moving_model(motion: str) -> FittedModel:
    trainer = small_trainer(motion, "pixel", 0, {"freeze_background": True}, "cpu")
    trainer.run(silent)
    scene = warm_up_scene()[0]
    settings = replace(MOTIONS[motion].defaults, **_SMALL.get(motion, {}))
    spec = MotionSpec(motion, measure(start_of(scene), scene), settings)
    return FittedModel(trainer.pieces(), trainer.background, trainer.motion, scene.duration_us, "cpu", spec)


def _provenance() -> Provenance:
    scene = warm_up_scene()[0]
    method = {"name": "hard-cases", "version": "0", "params": {}, "seed": 0, "trained_on": []}
    return Provenance(
        method, scene.id, "0" * 64, "none", scene.cameras, scene.rate_hz, scene.n_ticks, scene.radiance_gain, 1.0,
        "cpu", 0.0, harness(), utc_now(),
    )  # fmt: skip
