"""World `mirror`: a block tumbles before a mirror, and a ball flies behind a pane of glass that reflects both faintly.

Hard for what takes an image for surfaces: a reflection moves where nothing solid moves, at a depth behind the wall, and
through the pane two depths are seen in one pixel, one of them still.

The lamp is a point. Light that a mirror or a pane casts on other surfaces is left out, and a pane's shadow is that of a
solid; the lamp is in the plane of the pane, whose shadow is thus a line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from spike4dgs.generators.worlds.base import Part, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import Mesh, box, ellipsoid, merge, quad, rotation, translation
from spike4dgs.generators.worlds.parts.desk import BLOCKS, block_image, low_rig, room
from spike4dgs.generators.worlds.parts.rigid_bodies import GRAVITY_M_S2
from spike4dgs.generators.worlds.surfaces import Material
from spike4dgs.generators.worlds.textures import BEACH_BALL, cloth, paving

_PANE = np.array([[-0.36, -0.27], [-0.17, 0.06]])  # its lower corners, x and y
_PANE_M = 0.42  # its height
_MIRROR = np.array([[0.02, 0.42], [0.62, 0.26]])
_MIRROR_Z = (0.03, 0.45)


@dataclass(frozen=True)
class _Throw:
    """The random choices of a variant; the defaults are those of variant 0."""

    speed_m_s: float = 6.0
    spin_rad_s: float = 30.0
    letter: str = "R"
    colour: int = 1
    lamp_m: float = 0.85  # from the pane's nearer corner, in its plane
    lamp_z_m: float = 1.7


def _sample(variant: int, rng: np.random.Generator) -> _Throw:
    if variant == 0:
        return _Throw()
    letter, colour = "EFGJLPQR"[int(rng.integers(8))], int(rng.integers(len(BLOCKS)))
    lamp = rng.uniform(0.7, 0.95), rng.uniform(1.5, 1.8)
    return _Throw(rng.uniform(5.5, 7.0), rng.choice([-1.0, 1.0]) * rng.uniform(20, 40), letter, colour, *lamp)


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. At half of `duration_s` the block is before the mirror and the ball behind the pane."""
    rng = rng_for("mirror", seed, variant)
    throw = _sample(variant, rng)
    along = _PANE[0] - _PANE[1]
    position = *(_PANE[0] + throw.lamp_m * along / np.linalg.norm(along)), throw.lamp_z_m

    def poses(t_s: float) -> dict[str, np.ndarray]:
        late = t_s - duration_s / 2
        across, fallen = throw.speed_m_s * late, GRAVITY_M_S2 / 2 * late**2
        turn = rotation("z", throw.spin_rad_s * late) @ rotation("y", 0.6)
        return {
            "block": translation(0.19 + 0.6 * across, 0.02, 0.17 + 0.3 * across - fallen) @ turn,
            "ball": translation(-0.25 + across, 0.22, 0.24 - fallen) @ rotation("y", throw.spin_rad_s * late),
        }

    return WorldScene(
        duration_s=duration_s,
        static=_static(rng),
        groups=_movers(throw, rng),
        instances={"block": "block", "ball": "ball"},
        emitters=_emitters(position),
        poses=poses,
        exposure=1.25,
        rig=low_rig(1.25, 0.2),
        shadow_sources=np.array([[*position, 1.0]]),
        depth_range=(0.6, 5.0),
        notes={"speed_m_s": throw.speed_m_s, "length_m": 0.09, "spin_rad_s": abs(throw.spin_rad_s)},
    )


def _emitters(position: tuple[float, float, float]) -> dict[str, dict[str, Any]]:
    return {
        "lamp": {
            "type": "point",
            "position": list(position),
            "intensity": {"type": "rgb", "value": [6.2, 5.9, 5.5]},
        },
        "room": {
            "type": "constant",
            "radiance": {"type": "rgb", "value": [0.40, 0.43, 0.48]},
            "sampling_weight": 0.0,
        },
    }


def _static(rng: np.random.Generator) -> dict[str, Part]:
    """Return the room, a wall behind the cameras, the mirror and the pane in their frames."""
    low, high = _MIRROR_Z
    cloths = paving((510, 720), rng, (34, 60), (0.20, 0.26, 0.34), (0.62, 0.58, 0.48), (0.75, 0.72, 0.66), 0.6, gap=4)
    return room(rng) | {
        "behind": Part(quad((0, -2.4, 0.5), (-4.8, 0, 0), (0, 0, 3.4)), Material(cloths)),
        "mirror": Part(_upright(_MIRROR, low, high), Material((0.90, 0.90, 0.90), 0, metal=True)),
        "mirror_frame": Part(_frame(_MIRROR, low, high, 0.018), Material((0.30, 0.16, 0.07), 0.2)),
        "pane": Part(_upright(_PANE, 0.012, _PANE_M), Material((0.0, 0.0, 0.0), glass=True)),
        "pane_frame": Part(_frame(_PANE, 0.006, _PANE_M, 0.012), Material((0.12, 0.12, 0.13), 0.2)),
    }


def _upright(feet: np.ndarray, low: float, high: float) -> Mesh:
    """Return a vertical rectangle over two points [2, 2] of the desk."""
    middle, side = feet.mean(0), feet[1] - feet[0]
    return quad((*middle, (low + high) / 2), (*side, 0), (0, 0, high - low))


def _frame(feet: np.ndarray, low: float, high: float, thick: float) -> Mesh:
    """Return bars around a vertical rectangle."""
    side = feet[1] - feet[0]
    length, height = float(np.linalg.norm(side)), high - low
    bars = [box((length + thick, thick, thick), (0, 0, h)) for h in (low, high)]
    bars += [box((thick, thick, height), (s * length / 2, 0, (low + high) / 2)) for s in (-1, 1)]
    placed = translation(*feet.mean(0), 0) @ rotation("z", float(np.arctan2(side[1], side[0])))
    return merge(bars).moved(placed)


def _movers(throw: _Throw, rng: np.random.Generator) -> dict[str, tuple[Part, ...]]:
    face = block_image(throw.letter, BLOCKS[throw.colour], rng)
    stripes = cloth((48, 96), rng, BEACH_BALL[:3], 16)
    return {
        "block": (Part(box((0.09, 0.09, 0.09)), Material(face, 0.25)),),
        "ball": (Part(ellipsoid((0.045, 0.045, 0.045), segments=32), Material(stripes, 0.15)),),
    }


WORLD = World("mirror", "A block before a mirror, a ball behind glass", build)
