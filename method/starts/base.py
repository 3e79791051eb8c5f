"""The initialisation part of a recipe, as a fit sees it: a request, and a start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.settings import Settings


@dataclass(frozen=True, eq=False)
class Start:
    """A pose for each training camera, and first points on surfaces."""

    cameras: tuple[Camera, ...]
    points: Float32  # [N, 3] m
    values: Float32  # [N] gray radiance


@dataclass(frozen=True, eq=False)
class StartRequest:
    """Everything that an initialisation may use."""

    scene: TrainingScene
    seed: int
    settings: Any  # the initialisation's own, as the recipe overrides them
    device: str = "cpu"  # of the fit


@dataclass(frozen=True)
class Initialization:
    """An entry of the table of initialisations: the function, and the defaults of its settings.

    A setting `flat_field` follows the recipe's `images.flat_field` unless the recipe says otherwise.
    """

    start: Callable[[StartRequest], Start]
    settings: Settings = Settings()
    label: str | None = None  # in descriptions of recipes; None: the name
    estimates_poses: bool = False  # those given serve for nothing but the frame
    calibrated: bool = False  # takes the cameras' calibrations, whether `flat_field` or not
