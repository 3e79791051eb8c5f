"""World `turntable`: letters and toy blocks on a disc that spins on a desk.

Even variants turn about 5 times a second; odd ones are hard: 20 to 25 times.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Part, RigSpec, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import (
    Mesh,
    box,
    disc,
    loft,
    revolve,
    rotation,
    translation,
)
from spike4dgs.generators.worlds.parts.desk import BLOCKS, INK, block_image, room
from spike4dgs.generators.worlds.surfaces import Lamp, Material
from spike4dgs.generators.worlds.textures import Canvas, cloth, fractal, mix, plain

DISC_RADIUS_M, DISC_TOP_M = 0.32, 0.05


@dataclass(frozen=True)
class _Setup:
    """The random choices of a variant; the defaults are those of variant 0."""

    turns_per_s: float = 5.0
    first_letter: int = 0
    start_rad: float = 0.2
    lamp: Lamp = Lamp()


def _sample(variant: int, rng: np.random.Generator) -> _Setup:
    if variant == 0:
        return _Setup()
    side = rng.choice([-1.0, 1.0])
    position = (side * rng.uniform(0.5, 1.0), rng.uniform(-0.9, -0.5), rng.uniform(1.5, 1.9))
    turns = (rng.uniform(20.0, 25.0) if variant % 2 else rng.uniform(4.0, 5.5)) * rng.choice([-1.0, 1.0])
    return _Setup(turns, int(rng.integers(8)), rng.uniform(0, 2 * np.pi), Lamp(position, rng.uniform(0.85, 1.1)))


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. The disc turns steadily (counter-clockwise from above in variant 0) during the whole clip."""
    rng = rng_for("turntable", seed, variant)
    setup = _sample(variant, rng)

    def poses(t_s: float) -> dict[str, np.ndarray]:
        return {"disc": rotation("z", setup.start_rad + 2 * np.pi * setup.turns_per_s * t_s)}

    return WorldScene(
        duration_s=duration_s,
        static=room(rng),
        groups={"disc": _disc_parts(setup, rng)},
        instances={"disc": "disc"},
        emitters=setup.lamp.emitters(),
        poses=poses,
        exposure=1.25,
        rig=RigSpec(
            center=(0.0, -1.12, 1.02), target=(0.0, 0.03, 0.02), spacing_m=(0.075, 0.065), toe_in=0.8, fov_x_deg=42.0
        ),
        shadow_sources=setup.lamp.points,
        depth_range=(0.7, 4.0),
        notes={
            "speed_m_s": 2 * np.pi * DISC_RADIUS_M * abs(setup.turns_per_s),
            "length_m": 2 * DISC_RADIUS_M,
            "turns_per_s": setup.turns_per_s,
        },
    )


# ---------------------------------------------------------------- the disc


def _disc_parts(setup: _Setup, rng: np.random.Generator) -> tuple[Part, ...]:
    """Return all parts that spin: the lettered top, the striped edge, a hub, blocks, a pawn, a cone and a ring."""
    stripes = mix(((np.arange(512) // 8) % 2)[None] * np.ones((6, 1)), (0.06, 0.06, 0.07), (0.80, 0.79, 0.75))
    edge = revolve([(DISC_RADIUS_M, 0.004), (DISC_RADIUS_M, DISC_TOP_M)], 128)
    r, z = DISC_RADIUS_M, DISC_TOP_M
    collar = revolve([(r, z), (r - 0.004, z + 0.003), (r - 0.010, z)], 128)
    radii = 0.052, 0.052, 0.036, 0.030, 0.036, 0.030, 0.014, 0
    heights = 0, 0.012, 0.018, 0.055, 0.062, 0.075, 0.085, 0.087
    hub = np.stack([radii, heights], 1)
    parts = [
        Part(disc(DISC_RADIUS_M - 0.006, DISC_TOP_M, 128), Material(_top_image(setup, rng), 0.3)),
        Part(edge, Material(stripes)),
        Part(collar, Material((0.72, 0.70, 0.64), 0.2)),
        Part(revolve(hub, 48).at(0, 0, DISC_TOP_M), Material((0.78, 0.76, 0.70), 0.25, metal=True)),
    ]
    for k, colour in enumerate(BLOCKS[:3]):
        angle = 2 * np.pi * (k / 3 + 0.06)
        size = (0.066, 0.058, 0.072)[k]
        block = box((size, size, size), (0, 0, DISC_TOP_M + size / 2)).moved(rotation("z", 0.4 + k))
        at = translation(0.165 * np.cos(angle), 0.165 * np.sin(angle), 0)
        parts.append(Part(block.moved(at), Material(block_image("XYZ"[k], colour, rng), 0.25)))
    parts += _small_objects(rng)
    return tuple(parts)


def _small_objects(rng: np.random.Generator) -> list[Part]:
    """Return a pawn, a cone and a striped post between the blocks."""

    def around(mesh: Mesh, turn: float) -> Mesh:
        return mesh.at(0.17 * np.cos(2 * np.pi * turn), 0.17 * np.sin(2 * np.pi * turn), DISC_TOP_M)

    radii = 0.030, 0.030, 0.018, 0.011, 0.019, 0.010, 0.017, 0.019, 0.013, 0
    heights = 0, 0.008, 0.018, 0.050, 0.056, 0.060, 0.068, 0.078, 0.092, 0.096
    pawn = revolve(np.stack([radii, heights], 1), 32)
    cone = revolve([(0.036, 0), (0.036, 0.006), (0.028, 0.006), (0.006, 0.085), (0, 0.086)], 32)
    rows = ((np.arange(64) // 11) % 2)[:, None] * np.ones((1, 4))
    ring = np.linspace(0, 2 * np.pi, 25)[:-1]
    post = loft(
        np.stack([np.stack([0.018 * np.cos(ring), 0.018 * np.sin(ring), 0 * ring + h], 1) for h in (0.0, 0.11)])
    )
    spiral = cloth((48, 48), rng, [(0.10, 0.22, 0.55), (0.82, 0.80, 0.74)], 8)
    return [
        Part(around(pawn, 0.23), Material((0.07, 0.06, 0.06), 0.12)),
        Part(around(cone, 0.56), Material(mix(rows, (0.80, 0.30, 0.05), (0.82, 0.80, 0.76)))),
        Part(around(post, 0.90), Material(spiral, 0.2)),
    ]


def _top_image(setup: _Setup, rng: np.random.Generator) -> np.ndarray:
    """Return sectors, letters that read from the rim inwards, a tick scale and a dark middle with a hand."""
    n, r = 720, DISC_RADIUS_M - 0.006
    c = Canvas(plain((n, n), (0.74, 0.71, 0.62)), n / (2 * r))

    def polar(radius: float, angle: float) -> tuple[float, float]:
        return r + radius * np.cos(angle), r - radius * np.sin(angle)

    for k in range(0, 16, 2):
        fan = [polar(0.315, a) for a in np.pi / 8 * (k + np.linspace(-0.5, 0.5, 9))]
        c.polygon([(r, r), *fan], (0.34, 0.42, 0.52) if k % 4 else (0.56, 0.40, 0.30))
    for k in range(8):
        angle = 2 * np.pi * k / 8
        letter = "ABCDEFGH"[(k + setup.first_letter) % 8]
        c.text(letter, *polar(0.245, angle), 0.068, INK[(k + setup.first_letter) % 4], np.degrees(angle) - 90)
    for k in range(96):
        inner = 0.296 if k % 6 else 0.284
        c.line([polar(inner, 2 * np.pi * k / 96), polar(0.308, 2 * np.pi * k / 96)], 0.003, (0.05, 0.05, 0.06))
    c.ellipse(r, r, 0.122, 0.122, (0.80, 0.78, 0.70))
    c.ellipse(r, r, 0.116, 0.116, (0.10, 0.11, 0.14))
    for k in range(24):
        dot, size = polar(0.104, 2 * np.pi * k / 24), 0.004 if k % 3 else 0.007
        c.ellipse(*dot, size, size, (0.75, 0.70, 0.50))
    hand = [polar(0.05, -0.15), polar(0.094, 0.0), polar(0.05, 0.15)]
    c.polygon(hand, (0.82, 0.62, 0.10))
    return c.image * (0.86 + 0.18 * fractal((n, n), rng, 64, 2))[..., None]


WORLD = World("turntable", "Letters and blocks on a spinning disc", build)
