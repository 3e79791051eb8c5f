"""World `appear`: a block flies out from behind a board, a ball disappears behind another, a jack pops up from a box.

Hard for what follows points over the whole clip, or learns one set of points at one time: at the start nothing of the
block and the jack is seen by any camera, at the end nothing of the ball.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Part, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import box, ellipsoid, revolve, rotation, translation
from spike4dgs.generators.worlds.parts.desk import BLOCKS, block_image, low_rig, room
from spike4dgs.generators.worlds.parts.rigid_bodies import GRAVITY_M_S2
from spike4dgs.generators.worlds.surfaces import Lamp, Material
from spike4dgs.generators.worlds.textures import BEACH_BALL, cloth, wood

EDGE_M = 0.20  # from the middle to either board
_LANE_Y_M = 0.12
_BOARD_M = (1.0, 0.02, 0.46)
_CRATE_M = (0.15, 0.12, 0.16)
_RISE_M = 0.12  # of the jack
_STEEPEST = 1.5  # of smoothstep: its largest slope


@dataclass(frozen=True)
class _Run:
    """The random choices of a variant; the defaults are those of variant 0."""

    speed_m_s: float = 8.0
    spin_rad_s: float = 25.0
    letter: str = "A"
    colour: int = 0
    lamp: Lamp = Lamp((-0.5, -0.9, 1.7))


def _sample(variant: int, rng: np.random.Generator) -> _Run:
    if variant == 0:
        return _Run()
    lamp = Lamp((rng.uniform(-0.8, 0.8), rng.uniform(-1.0, -0.7), rng.uniform(1.5, 1.9)), rng.uniform(0.9, 1.1))
    letter, colour = "ABCDEFGH"[int(rng.integers(8))], int(rng.integers(len(BLOCKS)))
    return _Run(rng.uniform(7.5, 9.0), rng.uniform(15, 35), letter, colour, lamp)


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. At half of `duration_s` an edge hides half of the block and of the ball, and the jack's body."""
    rng = rng_for("appear", seed, variant)
    run = _sample(variant, rng)

    def poses(t_s: float) -> dict[str, np.ndarray]:
        late = t_s - duration_s / 2
        across, fallen = run.speed_m_s * late, GRAVITY_M_S2 / 2 * late**2
        rise = np.clip(0.5 + late * run.speed_m_s / _STEEPEST / _RISE_M, 0, 1)
        turn = rotation("y", run.spin_rad_s * late)
        return {
            "block": translation(across - EDGE_M, _LANE_Y_M, 0.24 - fallen) @ turn,
            "ball": translation(across + EDGE_M, _LANE_Y_M, 0.36 - fallen) @ turn,
            "jack": translation(0, 0, _RISE_M * rise * rise * (3 - 2 * rise)),
        }

    return WorldScene(
        duration_s=duration_s,
        static=room(rng) | _screens(rng),
        groups=_movers(run, rng),
        instances={"block": "block", "ball": "ball", "jack": "jack"},
        emitters=run.lamp.emitters(),
        poses=poses,
        exposure=1.25,
        rig=low_rig(1.3, 0.24),
        shadow_sources=run.lamp.points,
        depth_range=(0.6, 5.0),
        notes={"speed_m_s": run.speed_m_s, "length_m": 0.09, "spin_rad_s": run.spin_rad_s},
    )


def _screens(rng: np.random.Generator) -> dict[str, Part]:
    """Return two boards that reach beyond the image, and a crate in the middle: what hides the objects."""
    found = {}
    for name, side in (("left", -1), ("right", 1)):
        middle = (side * (EDGE_M + _BOARD_M[0] / 2), 0.0, _BOARD_M[2] / 2)
        found[f"{name}_board"] = Part(box(_BOARD_M, middle), Material(1.3 * wood((230, 500), rng, 5)))
    crate = box(_CRATE_M, (0.0, -0.11, _CRATE_M[2] / 2))
    return found | {"crate": Part(crate, Material(cloth((64, 64), rng, [BLOCKS[2], (0.80, 0.78, 0.70)], 16)))}


def _movers(run: _Run, rng: np.random.Generator) -> dict[str, tuple[Part, ...]]:
    face = block_image(run.letter, BLOCKS[run.colour], rng)
    stripes = cloth((48, 96), rng, BEACH_BALL[:3], 16)
    body = revolve([(0.0, 0.0), (0.045, 0.0), (0.034, 0.055), (0.0, 0.055)], 32)
    hat = revolve([(0.0, 0.112), (0.012, 0.110), (0.026, 0.086), (0.028, 0.084), (0.0, 0.084)], 32)
    coat = cloth((32, 64), rng, [(0.10, 0.25, 0.60), (0.82, 0.62, 0.10)], 8)
    return {
        "block": (Part(box((0.07, 0.07, 0.07)), Material(face, 0.25)),),
        "ball": (Part(ellipsoid((0.04, 0.04, 0.04), segments=32), Material(stripes, 0.15)),),
        "jack": (
            Part(body, Material(coat)),
            Part(ellipsoid((0.027, 0.027, 0.03), (0, 0, 0.072), 24), Material((0.72, 0.50, 0.36))),
            Part(hat, Material((0.62, 0.05, 0.05), 0.3)),
        ),
    }


WORLD = World("appear", "Objects appear from behind screens and disappear", build)
