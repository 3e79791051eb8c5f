"""The floor `nearest-view`: the image that the nearest training camera takes at that time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.method import FitRequest
from spike4dgs.benchmark.scene.camera_state import local_ticks
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.screen.shown import Shown
from spike4dgs.method.images.base import ImageMaker


@dataclass(frozen=True, eq=False, repr=False)
class NearestViewModel(Shown):
    """Nothing is fitted: images are made from the training streams when they are asked for."""

    scene: TrainingScene
    images: ImageMaker

    def _about(self) -> str:
        return f"of {self.scene.id}: {self.images.name} images of {len(self.scene.cameras)} cameras"

    def render(self, camera: Camera, t_us: float) -> NDArray[np.float32]:
        """Return the image [H, W] of the training camera whose centre is nearest to `camera`'s; the first of equals."""
        distances = [float(np.linalg.norm(c.center - camera.center)) for c in self.scene.cameras]
        # Rounded to a micrometre: equals on paper must not be told apart by the last bit.
        nearest = int(np.argmin(np.round(distances, 6)))
        stream, state = self.scene.streams[nearest], self.scene.state(self.scene.cameras[nearest].id)
        ticks, _ = local_ticks(state.clock, [self.scene.tick(t_us)], stream.n_ticks)
        return self.images(stream, ticks, self.scene.radiance_gain * state.gain)[0]


@dataclass(repr=False)
class NearestView(Shown):
    """`benchmark.method.Method` without any reconstruction: what a method must beat to be worth its time."""

    name: str
    images: ImageMaker
    description: str = "the nearest training camera's image, without any reconstruction"
    given: tuple[str, ...] = ("poses",)
    params: dict[str, Any] = field(init=False)

    def _about(self) -> str:
        return f"{self.name}: {self.description}"

    def __post_init__(self) -> None:
        self.params = {"name": self.name, "images": self.images.name}

    def fit(self, scene: TrainingScene, request: FitRequest) -> NearestViewModel:
        """Return the model at once; nothing but the progress of the request is used."""
        request.progress(1, 1)
        return NearestViewModel(scene, self.images)
