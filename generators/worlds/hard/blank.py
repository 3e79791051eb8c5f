"""World `blank`: a jug of one colour moves and turns before a floor and a wall of one other colour.

Hard for what matches or follows texture: there is none. Outline, shading and shadow alone say where the jug is and how
it turns.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Part, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import quad, revolve, rotation, translation, tube
from spike4dgs.generators.worlds.parts.desk import low_rig
from spike4dgs.generators.worlds.surfaces import Colour, Lamp, Material

_OUTSIDE = (0.0, 0.0), (0.06, 0.0), (0.095, 0.06), (0.09, 0.12), (0.05, 0.175), (0.06, 0.20)
_INSIDE = (0.06, 0.20), (0.054, 0.20), (0.044, 0.175), (0.084, 0.12), (0.089, 0.06), (0.05, 0.01), (0.0, 0.01)
_HEIGHT_M = 0.20


@dataclass(frozen=True)
class _Throw:
    """The random choices of a variant; the defaults are those of variant 0."""

    speed_m_s: float = 6.0
    spin_rad_s: float = 30.0
    jug: Colour = (0.62, 0.60, 0.56)
    room: Colour = (0.36, 0.38, 0.40)
    lamp: Lamp = Lamp((-0.8, -0.8, 1.7))


def _sample(variant: int, rng: np.random.Generator) -> _Throw:
    if variant == 0:
        return _Throw()
    side = rng.choice([-1.0, 1.0])
    lamp = Lamp((side * rng.uniform(0.5, 0.9), rng.uniform(-0.9, -0.6), rng.uniform(1.5, 1.8)), rng.uniform(0.9, 1.1))
    jug, room = (tuple((grey + rng.uniform(-0.06, 0.06, 3)).tolist()) for grey in (0.6, rng.uniform(0.28, 0.42)))
    return _Throw(rng.uniform(6.0, 8.0), side * rng.uniform(20, 40), jug, room, lamp)


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. The jug is in the middle of the image at half of `duration_s`; it flies from left to right."""
    rng = rng_for("blank", seed, variant)
    throw = _sample(variant, rng)
    start_rad = rng.uniform(0, 2 * np.pi)

    def poses(t_s: float) -> dict[str, np.ndarray]:
        late = t_s - duration_s / 2
        spin = rotation("z", start_rad + throw.spin_rad_s * late)
        return {"jug": translation(throw.speed_m_s * late, 0.0, 0.16) @ rotation("y", 0.4) @ spin}

    a = np.linspace(-1.25, 1.25, 14)
    handle = tube(np.stack([0.07 + 0.06 * np.cos(a), 0 * a, 0.10 + 0.065 * np.sin(a)], 1), 0.011, 10)
    spout = tube([(-0.045, 0, 0.165), (-0.085, 0, 0.20)], [0.022, 0.012], 12)
    jug = [
        mesh.at(0, 0, -_HEIGHT_M / 2)
        for mesh in (*(revolve(np.array(p), 48) for p in (_OUTSIDE, _INSIDE)), handle, spout)
    ]
    floor, wall = quad((0, 0, 0), (6, 0, 0), (0, 4, 0)), quad((0, 0.7, 1.5), (6, 0, 0), (0, 0, 3))
    return WorldScene(
        duration_s=duration_s,
        static={"floor": Part(floor, Material(throw.room)), "wall": Part(wall, Material(throw.room))},
        groups={"jug": tuple(Part(mesh, Material(throw.jug)) for mesh in jug)},
        instances={"jug": "jug"},
        emitters=throw.lamp.emitters(),
        poses=poses,
        exposure=1.25,
        rig=low_rig(1.25, 0.18),
        shadow_sources=throw.lamp.points,
        depth_range=(0.6, 5.0),
        notes={"speed_m_s": throw.speed_m_s, "length_m": _HEIGHT_M, "spin_rad_s": abs(throw.spin_rad_s)},
    )


WORLD = World("blank", "A plain jug moves before a plain wall", build)
