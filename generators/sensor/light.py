"""Light that flickers: one factor for all of a scene, the same in every camera.

    sine:  1 + d cos(2 pi (f t + p))                  d = (highest - lowest) / (highest + lowest)
    LED:   high in a share `duty` of each period, low in the rest, with the same d and mean 1

d is the percent flicker of the lighting standards (IES RP-16), whose flicker index is d / pi for the sine. IEEE 1789
(2015) asks for at most 8 % at 100 Hz. The factor of a tick is its exact mean over the tick. An image of ground truth
has the factor of its instant, as it has the objects' places.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from spike4dgs.benchmark.arrays import Float32


@dataclass(frozen=True)
class Flicker:
    """A periodic factor of the light with mean 1.

    Attributes:
        depth: (highest - lowest) / (highest + lowest).
        per_tick: periods in a tick.
        phase: periods, at tick 0.
        duty: share of a period in which an LED is high; 0 is a sine.
    """

    depth: float
    per_tick: float
    phase: float
    duty: float = 0.0

    def at(self, tick: float) -> float:
        """Return the factor at the start of a tick."""
        periods = self.phase + self.per_tick * tick
        if self.duty == 0:
            return float(1 + self.depth * np.cos(2 * np.pi * periods))
        low, high = self._levels
        return high if periods % 1 < self.duty else low

    def mean(self, tick: int) -> float:
        """Return the mean of the factor over a tick."""
        start = self.phase + self.per_tick * tick
        return (self._integral(start + self.per_tick) - self._integral(start)) / self.per_tick

    def _integral(self, periods: float) -> float:
        """Return the integral of the factor from 0, over periods."""
        if self.duty == 0:
            return float(periods + self.depth * np.sin(2 * np.pi * periods) / (2 * np.pi))
        low, high = self._levels
        whole, rest = divmod(periods, 1)
        return float(whole + low * rest + (high - low) * min(rest, self.duty))

    @property
    def _levels(self) -> tuple[float, float]:
        mean = self.duty * (1 + self.depth) + (1 - self.duty) * (1 - self.depth)
        return (1 - self.depth) / mean, (1 + self.depth) / mean


STEADY = Flicker(depth=0.0, per_tick=1.0, phase=0.0)


class Light(Protocol):
    """A factor of the light: at the start of a tick, and its mean over a tick."""

    def at(self, tick: float) -> float: ...  # noqa: D102

    def mean(self, tick: int) -> float: ...  # noqa: D102


class FlickeringInstants(Sequence[Float32]):
    """The radiance at the start of every tick, in flickering light; `at` returns that in steady light at a tick."""

    def __init__(self, at: Callable[[int], Float32], n_ticks: int, light: Light) -> None:
        self._at, self._n, self._light = at, n_ticks, light

    def __len__(self) -> int:
        return self._n + 1

    def __getitem__(self, tick: Any) -> Any:  # one tick; slices are not needed
        return self._at(tick) * np.float32(self._light.at(tick))


class FlickeringMeans(Sequence[Float32]):
    """The mean radiance of every tick in flickering light.

    In steady light it is the mean of the curve through the radiance at the starts of ticks (`sensor.model`), or one of
    `means`, where these are known. The product of two means stands for the mean of the product. They differ by the
    covariance of light and image in the tick, about the product of their changes in it / 12: in a sine of 8 % at 100 Hz
    by up to 2e-4 of the change of the image, more in deeper and faster flicker.
    """

    def __init__(
        self, at: Callable[[int], Float32], n_ticks: int, light: Light, means: Sequence[Float32] | None = None
    ) -> None:
        self._at, self._n, self._light, self._means = at, n_ticks, light, means

    def __len__(self) -> int:
        return self._n

    def __getitem__(self, tick: Any) -> Any:  # one tick; slices are not needed
        steady = tick_mean(self._at, tick, self._n) if self._means is None else self._means[tick]
        return steady * np.float32(self._light.mean(tick))


def tick_mean(at: Callable[[int], Float32], tick: int, last: int) -> Float32:
    """Return the mean over a tick of the clamped curve through the radiance at the starts of ticks 0 .. last."""
    p1, p2 = at(tick), at(tick + 1)
    before, after = (at(tick - 1) if tick else p1), (at(tick + 2) if tick + 2 <= last else p2)
    m1 = (p2 - before) * np.float32(0.5 if tick else 1.0)
    m2 = (after - p1) * np.float32(0.5 if tick + 2 <= last else 1.0)
    mean = (p1 + p2) * np.float32(0.5) + (m1 - m2) * np.float32(1 / 12)
    return np.asarray(np.clip(mean, np.minimum(p1, p2), np.maximum(p1, p2)))
