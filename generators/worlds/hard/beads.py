"""World `beads`: a burst of many small glass beads flies up from a bowl.

Hard for what needs a neighbourhood: each bead is a few pixels wide, crosses others at another depth, and flies several
of its diameters in a millisecond or two; there are more bodies than a method can follow one by one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Deforming, Part, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import ellipsoid, merge, revolve
from spike4dgs.generators.worlds.parts.desk import low_rig, room
from spike4dgs.generators.worlds.parts.rigid_bodies import GRAVITY_M_S2, owners
from spike4dgs.generators.worlds.surfaces import Colour, Lamp, Material

BURST_S = 0.06  # from the burst to the middle of the clip
_SOURCE = np.array([0.0, 0.0, 0.05])
_COLOURS: tuple[Colour, ...] = (
    (0.75, 0.06, 0.05),
    (0.06, 0.20, 0.65),
    (0.08, 0.45, 0.16),
    (0.82, 0.55, 0.05),
    (0.80, 0.78, 0.72),
    (0.04, 0.04, 0.05),
)


@dataclass(frozen=True)
class _Burst:
    """The random choices of a variant; the defaults are those of variant 0."""

    count: int = 160
    lamp: Lamp = Lamp((0.6, -0.8, 1.7))


def _sample(variant: int, rng: np.random.Generator) -> _Burst:
    if variant == 0:
        return _Burst()
    side = rng.choice([-1.0, 1.0])
    lamp = Lamp((side * rng.uniform(0.4, 0.9), rng.uniform(-0.9, -0.6), rng.uniform(1.5, 1.8)), rng.uniform(0.9, 1.1))
    return _Burst(int(rng.integers(140, 221)), lamp)


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. The beads left the bowl 60 ms before half of `duration_s`, and fly freely."""
    rng = rng_for("beads", seed, variant)
    burst = _sample(variant, rng)
    turn, rise = rng.uniform(0, 2 * np.pi, burst.count), np.radians(rng.uniform(20, 90, burst.count))
    ways = np.stack([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)], 1)
    velocities = ways * rng.uniform(2.5, 8.0, burst.count)[:, None]
    beads = [ellipsoid([radius] * 3, segments=10) for radius in rng.uniform(0.005, 0.010, burst.count)]
    local = merge(beads)
    owner, bodies = owners(beads)
    shades = (rng.integers(0, len(_COLOURS), burst.count) + 0.5) / len(_COLOURS)
    local.uv[:] = np.stack([shades[owner], np.full(len(owner), 0.5)], 1)

    def vertices(t_s: float) -> np.ndarray:
        late = max(t_s - duration_s / 2 + BURST_S, 0.0)
        centres = _SOURCE + velocities * late
        centres[:, 2] -= GRAVITY_M_S2 / 2 * late**2
        return np.asarray(local.vertices + centres[owner])

    bowl = revolve([(0.0, 0.0), (0.05, 0.0), (0.085, 0.045), (0.08, 0.045), (0.045, 0.006), (0.0, 0.006)], 40)
    glass = Part(local, Material(np.float32([np.repeat(_COLOURS, 4, axis=0)]), 0.1))
    return WorldScene(
        duration_s=duration_s,
        static=room(rng) | {"bowl": Part(bowl, Material((0.55, 0.60, 0.62), 0.15))},
        groups={},
        instances={},
        emitters=burst.lamp.emitters(),
        poses=lambda t_s: {},
        exposure=1.25,
        rig=low_rig(1.2, 0.26),
        shadow_sources=burst.lamp.points,
        depth_range=(0.3, 5.0),
        notes={
            "speed_m_s": float(np.linalg.norm(velocities, axis=1).mean()),
            "length_m": 0.015,
            "bodies": float(burst.count),
        },
        deforming={"bead": Deforming(glass, vertices, bodies)},
    )


WORLD = World("beads", "A burst of many small beads", build)
