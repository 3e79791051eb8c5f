"""World `flash`: a lamp flashes over one side of a desk, where a block tumbles; the room light is steady.

Hard for what explains every change by motion, or by one factor for the whole image: within a millisecond the light of
things at rest doubles, with new shadows, and fades; far from the lamp nearly nothing changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Flash, Part, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import box, rotation, translation
from spike4dgs.generators.worlds.parts.desk import BLOCKS, block_image, low_rig, room
from spike4dgs.generators.worlds.parts.rigid_bodies import GRAVITY_M_S2
from spike4dgs.generators.worlds.surfaces import Lamp, Material

RISE_S = 2e-4
_FIRST_S = -1e-3  # of a flash, from the middle of the clip


@dataclass(frozen=True)
class _Light:
    """The random choices of a variant; the defaults are those of variant 0."""

    speed_m_s: float = 5.0
    spin_rad_s: float = 25.0
    letter: str = "F"
    colour: int = 0
    every_s: float = 7e-3
    fade_s: float = 1.8e-3
    side: float = 1.0
    height_m: float = 0.95


def _sample(variant: int, rng: np.random.Generator) -> _Light:
    if variant == 0:
        return _Light()
    letter, colour = "EFGJLPQR"[int(rng.integers(8))], int(rng.integers(len(BLOCKS)))
    motion = rng.uniform(4.5, 6.0), rng.uniform(20, 40)
    flashes = rng.uniform(5e-3, 8e-3), rng.uniform(1e-3, 2e-3)
    return _Light(*motion, letter, colour, *flashes, rng.choice([-1.0, 1.0]), rng.uniform(0.85, 1.0))


def brightness(t_s: float, every_s: float, fade_s: float) -> float:
    """Return the brightness at a time from the first of flashes that return for ever: a quick rise, a slow fade.

    Each is (1 - exp(-t / RISE_S)) exp(-t / fade_s); what is left of earlier ones adds to it.
    """
    since = t_s % every_s + every_s * np.arange(4)
    return float(((1 - np.exp(-since / RISE_S)) * np.exp(-since / fade_s)).sum())


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. A flash begins 1 ms before half of `duration_s`; the block is then in the middle."""
    rng = rng_for("flash", seed, variant)
    light = _sample(variant, rng)
    lamp = Lamp((-0.5 * light.side, -0.9, 1.7), 0.75)
    bulb = Lamp((0.75 * light.side, -0.45, light.height_m), target=(0.28 * light.side, 0.30, 0.05))

    def poses(t_s: float) -> dict[str, np.ndarray]:
        late = t_s - duration_s / 2
        turn = rotation("z", light.spin_rad_s * late) @ rotation("y", 0.6)
        place = light.side * (0.14 + light.speed_m_s * late), 0.05, 0.16 - GRAVITY_M_S2 / 2 * late**2
        return {"block": translation(*place) @ turn}

    face = block_image(light.letter, BLOCKS[light.colour], rng)
    spot = {
        "type": "spot",
        "to_world": bulb.frame,
        "intensity": {"type": "rgb", "value": [6.0, 5.4, 4.4]},
        "cutoff_angle": 26.0,
        "beam_width": 12.0,
    }
    return WorldScene(
        duration_s=duration_s,
        static=room(rng),
        groups={"block": (Part(box((0.09, 0.09, 0.09)), Material(face)),)},
        instances={"block": "block"},
        emitters=lamp.emitters(0.7),
        poses=poses,
        exposure=1.25,
        rig=low_rig(1.25, 0.2),
        shadow_sources=lamp.points,
        depth_range=(0.6, 5.0),
        notes={
            "speed_m_s": light.speed_m_s,
            "length_m": 0.09,
            "flash_every_ms": 1e3 * light.every_s,
            "flash_fade_ms": 1e3 * light.fade_s,
        },
        flash=Flash(
            {"bulb": spot},
            bulb.points[:1],
            lambda t_s: brightness(t_s - duration_s / 2 - _FIRST_S, light.every_s, light.fade_s),
        ),
    )


WORLD = World("flash", "A lamp flashes over a desk where a block tumbles", build)
