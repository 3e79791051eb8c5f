"""The toy world seen by cameras whose clocks differ, in closed form."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from toy_world import ToyWorld

from spike4dgs.benchmark.scene.camera_state import Clock
from spike4dgs.benchmark.scene.cameras import Camera


@dataclass(frozen=True)
class ClockWorld(ToyWorld):
    """At a camera's tick k it sees the world at the array's tick `clocks[camera].shared(k)`, real valued."""

    width: int = 96
    height: int = 60
    n_ticks: int = 240
    travel: float = 0.6  # 38 px a metre: 0.095 px a tick
    seed: int = 1
    clocks: Mapping[str, Clock] = field(default_factory=dict)

    def trace(self, camera: Camera, t: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """As the toy world's, at the array's time."""
        return super().trace(camera, self.clocks.get(camera.id, Clock()).shared(t * self.n_ticks) / self.n_ticks)
