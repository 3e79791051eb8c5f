"""Parts of bicycle and motorcycle: wheels that roll, and a rider posed by saddle, bars and foot rests.

A wheel's own coordinates: its axle is the y axis. A cycle's: x forward, y to the left, z up, origin on the ground.
"""

from __future__ import annotations

import numpy as np

from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.meshes import Mesh, box, merge, revolve, rotation, translation, tube
from spike4dgs.generators.worlds.parts import figure
from spike4dgs.generators.worlds.surfaces import Colour, Material

RUBBER = Material((0.028, 0.028, 0.03))


def tyre(radius_m: float, thick_m: float) -> Mesh:
    """Return a round tyre of this outer radius."""
    a = np.linspace(0, 2 * np.pi, 13)
    return revolve(np.stack([radius_m - thick_m + thick_m * np.cos(a), thick_m * np.sin(a)], 1), 48, "y")


def rim(radius_m: float, depth_m: float, half_width_m: float) -> Mesh:
    """Return a rim: a band of this outer radius."""
    r0, w = radius_m - depth_m, half_width_m
    return revolve([(radius_m, -w), (r0, -0.6 * w), (r0, 0.6 * w), (radius_m, w), (radius_m, -w)], 48, "y")


def spokes(radius_m: float, hub_m: float, count: int, thick_m: float, spread_m: float) -> Mesh:
    """Return round spokes from a hub, in turn from its left and right side."""
    found = []
    for k in range(count):
        y = spread_m * (1 if k % 2 else -1)
        found.append(tube([(0, y, hub_m), (0, 0, radius_m)], thick_m, 6).moved(rotation("y", 2 * np.pi * k / count)))
    return merge(found)


def reflector(radius_m: float, colour: Colour) -> Part:
    """Return a plate between the spokes, which distinguishes a whole turn of the wheel from a fraction."""
    return Part(box((0.10, 0.02, 0.055), (0, 0, 0.72 * radius_m)), Material(colour))


def rolling(center: tuple[float, float, float], radius_m: float, travelled_m: float) -> np.ndarray:
    """Return the pose of a wheel in the cycle's coordinates after it has rolled `travelled_m`."""
    return translation(*center) @ rotation("y", travelled_m / radius_m)


def seated(
    cycle: np.ndarray,
    hip: tuple[float, float, float],
    neck: tuple[float, float, float],
    grips: tuple[float, float, float],
    feet: dict[str, tuple[float, float, float]],
    head_down: float,
) -> dict[str, np.ndarray]:
    """Return a rider's poses from points in the cycle's coordinates: `grips`: left hand, `feet`: ankles by side."""

    def world(p: tuple[float, float, float]) -> np.ndarray:
        return np.asarray(cycle[:3, :3] @ np.array(p) + cycle[:3, 3])

    hands = {side: world((grips[0], sign * grips[1], grips[2])) for side, sign in figure.SIDES.items()}
    ankles = {side: world(feet[side]) for side in figure.SIDES}
    toes = dict.fromkeys(figure.SIDES, 0.15)
    return figure.poses(figure.Joints(world(hip), world(neck), hands, ankles, toes, head_down), "rider_")
