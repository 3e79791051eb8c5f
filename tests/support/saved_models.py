"""Small models of every kind, unfitted but moving, for tests of what is saved and shown."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import nn
from toy_world import GAIN, RATE_HZ, ToyWorld

from spike4dgs.baselines.radiance_field.model import Bounds, DynamicField, FieldShape, RadianceModel
from spike4dgs.baselines.recipes import PARTS
from spike4dgs.baselines.tracking.model import TrackedModel, Tracks
from spike4dgs.benchmark.runs.provenance import Provenance
from spike4dgs.method.gaussians.parameters import Gaussians, from_points
from spike4dgs.method.models.fitted_model import FittedModel, MotionSpec
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.motion.hexplane import HexPlaneSettings, HexPlaneShape
from spike4dgs.method.splat import Views
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.training_views.training_images import TrainingImages

MOTIONS = PARTS.motion

WORLD = ToyWorld(width=40, height=24, side=2, n_ticks=100)
DURATION_US = WORLD.n_ticks * 1e6 / RATE_HZ
LOW, HIGH = torch.tensor([-1.5, -0.5, 0.0]), torch.tensor([1.5, 1.0, 1.5])


def provenance(**changes: Any) -> Provenance:
    """Of a fit to the toy world."""
    method = {"name": "toy+4dgs", "version": "0", "params": {}, "seed": 0, "trained_on": []}
    scene = {"scene": "toy", "scene_revision": "0" * 64, "split": "center", "cameras": WORLD.cameras}
    clock = {"rate_hz": RATE_HZ, "n_ticks": WORLD.n_ticks, "radiance_gain": GAIN}
    fit = {"budget": 1.0, "device": "cpu", "fit_seconds": 1.5, "created": "2026-01-31T12:00:00Z"}
    values = {"method": method, **scene, **clock, **fit, "harness": {"version": "0", "commit": None, "dirty": None}}
    return Provenance(**{**values, **changes})


def shaken(module: nn.Module, size: float) -> nn.Module:
    """The module with random parameters added: no layer is zero any more."""
    rng = seeded(5, 0)
    with torch.no_grad():
        for p in module.parameters():
            p += size * torch.randn(p.shape, generator=rng)
    return module


def points(n: int = 120) -> Gaussians:
    """Gaussians of many grays in front of the cameras."""
    rng = np.random.default_rng(2)
    at = rng.uniform(LOW.numpy(), HIGH.numpy(), (n, 3)).astype(np.float32)
    return from_points(at, rng.uniform(0.2, 1, n).astype(np.float32), opacity=0.8)


def gaussian_model(motion: str, background: int = 0) -> FittedModel:
    """A model of the trainer with any motion, and some static Gaussians behind it."""
    settings = HexPlaneSettings(features=4, mlp_width=8) if motion == "hexplane" else MOTIONS[motion].defaults
    spec = MotionSpec(motion, Extent(LOW, HIGH, 2.0, WORLD.n_ticks, WORLD.width), settings)
    made = shaken(MOTIONS[motion](spec.extent, spec.settings, seeded(3, 0)), 0.2)
    images = TrainingImages(Views.from_cameras(WORLD.cameras), (25, 75), torch.rand(2, 4, 24, 40), WORLD.n_ticks)
    gaussians = made.initialize(points(), images)
    rng = seeded(4, 0)
    extra = {k: v + 0.1 * torch.randn(v.shape, generator=rng) for k, v in gaussians.extra.items()}
    moved = Gaussians.from_tensors({**gaussians.tensors(), **extra})
    return FittedModel((moved,), points().rows(torch.arange(background)), made, DURATION_US, "cpu", spec)


def tracked_model() -> TrackedModel:
    """Tracks of the first half of the Gaussians. As in a fit, two of the index tensors share their memory."""
    gaussians, rows = points(), torch.arange(90)
    tracks = Tracks.start(gaussians, rows[:60], rows, (10, 50, 90), RATE_HZ)
    tracks.means[1:] += 0.1 * torch.randn(tracks.means[1:].shape, generator=seeded(6, 0))
    return TrackedModel(gaussians, tracks, DURATION_US)


def field_model() -> RadianceModel:
    """A radiance field with tiny networks."""
    shape = FieldShape(3, 16, 2, 8, 3, 2, 6, 4, 8, 0.02, HexPlaneShape((4, 8), 5, 4, 8))
    bounds = Bounds(2.0, 5.0, LOW - 3, HIGH + 3, LOW, HIGH, 2.0)
    field = DynamicField(shape, bounds, 1 / GAIN, seeded(7, 0))
    shaken(field.deformation, 0.3)
    return RadianceModel(field, DURATION_US, "cpu")


MODELS: dict[str, Callable[[], Any]] = {
    **{name: (lambda name=name: gaussian_model(name)) for name in MOTIONS},
    "hexplane, background": lambda: gaussian_model("hexplane", background=40),
    "tracking": tracked_model,
    "radiance-field": field_model,
}


@cache
def model(name: str) -> Any:
    """A model of `MODELS`."""
    return MODELS[name]()
