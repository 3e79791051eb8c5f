"""What the bodies of cars, vans and motorcycles share. x forward, y to the left, z up, metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.meshes import merge, quad
from spike4dgs.generators.worlds.surfaces import Colour, Material
from spike4dgs.generators.worlds.textures import Canvas, plain


@dataclass(frozen=True)
class Livery:
    """Colours (linear RGB) and number of a car, or of a motorcycle and its rider."""

    body: Colour
    second: Colour
    number: str


@dataclass(frozen=True)
class Wheels:
    """Axles at x, the middle of each wheel at +-y; radius of wheels and of the arches above them."""

    axles_x: tuple[float, float]
    track_y: float
    radius: float
    arch: float

    def positions(self) -> list[tuple[float, float, float]]:
        """Return the wheel centres."""
        return [(x, s * self.track_y, self.radius) for x in self.axles_x for s in (-1, 1)]

    def stations(self, end: float, count: int, ends: Sequence[float], per_arch: int) -> np.ndarray:
        """Return positions of cross-sections: `count` even ones in +-end, `ends`, and dense ones along the arches."""
        angle, edge = np.linspace(0, np.pi, per_arch), self.arch + 0.004
        arches = [np.concatenate([x + self.arch * np.cos(angle), [x - edge, x + edge]]) for x in self.axles_x]
        return np.unique(np.round(np.concatenate([np.linspace(-end, end, count), ends, *arches]), 4))

    def cut(self, x: float, bottom: float) -> float:
        """Return the lower edge of the body at x, at least the wheel arch's."""
        for axle in self.axles_x:
            if abs(x - axle) <= self.arch:
                bottom = max(bottom, self.radius + np.sqrt(self.arch**2 - (x - axle) ** 2))
        return bottom


@dataclass(frozen=True)
class Section:
    """The roundness of a cross-section: radii, points of an arc and of a wall, and how the sides lean inwards.

    The sides lean by `lean` metres for each `per_m` metres above the `belt`; the top bulges by `crown`.
    """

    round_top: float
    round_bottom: float
    arc: int
    wall: int
    lean: float
    belt: float
    per_m: float = 1.0
    crown: float = 0.0

    def ring(self, x: float, half: float, bottom: float, top: float) -> np.ndarray:
        """Return a ring [m, 3] at x: a rounded rectangle of half width `half` from `bottom` to `top`."""
        r1, r0 = min(self.round_top, 0.45 * (top - bottom)), min(self.round_bottom, 0.3 * (top - bottom))
        a = np.linspace(0, np.pi / 2, self.arc)
        low = np.stack([half - r0 + r0 * np.sin(a), bottom + r0 - r0 * np.cos(a)], 1)
        up = np.linspace(bottom + r0, top - r1, self.wall + 2)[1:-1]
        wall = np.stack([np.full(self.wall, half), up], 1)
        high = np.stack([half - r1 + r1 * np.cos(a), top - r1 + r1 * np.sin(a)], 1)
        under = np.stack([np.linspace(0, half - r0, 4)[:-1], np.full(3, bottom)], 1)
        roof = np.stack([np.linspace(half - r1, 0, self.arc)[1:], np.full(self.arc - 1, top)], 1)
        y, z = np.concatenate([under, low, wall, high, roof]).T
        y = y - self.lean * np.clip(z - self.belt, 0, None) / self.per_m * (y / half)
        if self.crown:
            z = z - self.crown * (y / half) ** 2 * np.clip((z - bottom) / (top - bottom), 0, 1) ** 2
        ring = np.stack([np.full_like(y, x), y, z], 1)
        return np.concatenate([ring, (ring * [1, -1, 1])[-2:0:-1]])


def number_plates(words: str, front: tuple[float, float], back: tuple[float, float]) -> Part:
    """Return the plates at (x, z) in front and at the back."""
    plate = Canvas(plain((40, 160), (0.85, 0.85, 0.8)), 300)
    plate.text(words, 0.267, 0.067, 0.08, (0.02, 0.02, 0.05))
    quads = [quad((x, 0, z), (0, wide, 0), (0, 0, 0.12)) for (x, z), wide in ((front, 0.52), (back, -0.52))]
    return Part(merge(quads), Material(plate.image))
