"""The state of a camera in an array beside its pose: its clock, its gain, its bad pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Clock:
    """A camera's clock beside the array's: at the array's tick s the camera is at tick offset + (1 + drift) s."""

    offset_ticks: float = 0.0
    drift_ppm: float = 0.0

    def local(self, tick: float) -> float:
        """Return the camera's tick at a tick of the array.

        >>> round(Clock(3.0, 20.0).local(50_000), 6)
        50004.0
        """
        return self.offset_ticks + tick * (1 + self.drift_ppm * 1e-6)

    def shared(self, tick: float) -> float:
        """Return the array's tick at a tick of the camera."""
        return (tick - self.offset_ticks) / (1 + self.drift_ppm * 1e-6)


@dataclass(frozen=True, eq=False)
class CameraState:
    """The defaults are those of a perfect camera."""

    clock: Clock = Clock()
    gain: float = 1.0  # spikes per light, relative to the array's `radiance_gain`; beside any flat field
    bad: Mask | None = None  # [H, W], pixels whose spikes say nothing; None: no such pixel is known


PERFECT = CameraState()
