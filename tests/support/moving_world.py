"""The toy world, seen by an array that moves through it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from toy_world import ToyWorld

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.array_path import ArrayPath

COEFFICIENTS = np.array([[0.01, 0.006, -0.03, 0.06, 0.02, -0.03], [0.004, 0.0, 0.01, 0.0, 0.02, 0.01], np.zeros(6)])


@dataclass(frozen=True)
class MovingWorld(ToyWorld):
    """What a camera of the array sees at t is what it sees of the toy world from where it is then."""

    @property
    def path(self) -> ArrayPath:
        """The path of the array, which is where it is given in the middle of the clip."""
        return ArrayPath(COEFFICIENTS, np.mean([c.center for c in self.cameras], axis=0), 0.5)

    def trace(self, camera: Camera, t: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[Any]]:
        """See the base."""
        (posed,) = self.path.posed([camera], t)
        return super().trace(posed, t)
