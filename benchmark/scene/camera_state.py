"""The state of a camera in an array beside its pose: clock, gain, dark rate, bad pixels; its ticks for the array's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from spike4dgs.benchmark.arrays import Float32, Mask


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
    dark: float = 1.0  # dark rates, relative to those of the recordings
    shading: Float32 | None = None  # [H, W] relative sensitivity, smooth, mean 1, of a camera without recordings
    bad: Mask | None = None  # [H, W], pixels whose spikes say nothing; None: no such pixel is known


PERFECT = CameraState()


def local_tick(clock: Clock, tick: int) -> int:
    """Return the camera's tick nearest to a tick of the array; it may lie outside the camera's clip.

    >>> local_tick(Clock(2.6), 100)
    103
    """
    return math.floor(clock.local(tick) + 0.5)


def local_ticks(clock: Clock, ticks: Sequence[int], n_ticks: int) -> tuple[list[int], list[bool]]:
    """Return the camera's ticks, clamped to its clip of `n_ticks`, and which of them are inside it.

    >>> local_ticks(Clock(-3.0), [0, 3, 9], 10)
    ([0, 0, 6], [False, True, True])
    """
    found = [local_tick(clock, tick) for tick in ticks]
    return [min(max(t, 0), n_ticks - 1) for t in found], [0 <= t < n_ticks for t in found]


def local_window(clock: Clock, start: int, stop: int, n_ticks: int) -> tuple[int, int]:
    """Return the camera's window for a window [start, stop) of the array, as long, and moved into its clip if need be.

    >>> local_window(Clock(4.0), 3, 8, 20), local_window(Clock(4.0), 13, 18, 20)
    ((7, 12), (15, 20))
    """
    middle = (start + stop) // 2
    first = start + local_tick(clock, middle) - middle
    first = max(0, min(first, n_ticks - (stop - start)))
    return first, first + stop - start
