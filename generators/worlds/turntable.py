"""World `turntable`: letters and toy blocks on a disc that spins on a desk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from spike4dgs.generators.worlds.base import Part, RigSpec, World, WorldScene, rng_for
from spike4dgs.generators.worlds.materials import Colour, Material
from spike4dgs.generators.worlds.meshes import (
    Mesh,
    box,
    disc,
    ellipsoid,
    loft,
    merge,
    quad,
    revolve,
    rotation,
    translation,
    tube,
)
from spike4dgs.generators.worlds.textures import Canvas, cloth, fractal, mix, paving, plain, wood

DISC_RADIUS_M, DISC_TOP_M = 0.32, 0.05
_INK: tuple[Colour, ...] = ((0.55, 0.04, 0.03), (0.03, 0.07, 0.35), (0.03, 0.20, 0.07), (0.03, 0.03, 0.03))
_BLOCKS: tuple[Colour, ...] = ((0.75, 0.22, 0.14), (0.20, 0.50, 0.24), (0.78, 0.58, 0.12), (0.16, 0.32, 0.66))


@dataclass(frozen=True)
class _Setup:
    """What one variant draws. Variant 0 keeps these values."""

    turns_per_s: float = 5.0
    first_letter: int = 0
    start_rad: float = 0.2
    lamp: tuple[float, float, float] = (-0.85, -0.75, 1.7)
    lamp_power: float = 1.0


def _draw(variant: int, rng: np.random.Generator) -> _Setup:
    if variant == 0:
        return _Setup()
    side = rng.choice([-1.0, 1.0])
    lamp = (side * rng.uniform(0.5, 1.0), rng.uniform(-0.9, -0.5), rng.uniform(1.5, 1.9))
    turns = rng.uniform(4.0, 5.5) * rng.choice([-1.0, 1.0])
    return _Setup(turns, int(rng.integers(8)), rng.uniform(0, 2 * np.pi), lamp, rng.uniform(0.85, 1.1))


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """The disc turns steadily (counter-clockwise from above in variant 0) during all of `duration_s`."""
    rng = rng_for("turntable", seed, variant)
    setup = _draw(variant, rng)

    def poses(t_s: float) -> dict[str, np.ndarray]:
        return {"disc": rotation("z", setup.start_rad + 2 * np.pi * setup.turns_per_s * t_s)}

    return WorldScene(
        name="turntable",
        seed=seed,
        variant=variant,
        duration_s=duration_s,
        static=_room(rng),
        groups={"disc": _disc_parts(setup, rng)},
        instances={"disc": "disc"},
        emitters=_emitters(setup),
        poses=poses,
        exposure=1.25,
        rig=RigSpec(
            center=(0.0, -1.12, 1.02), target=(0.0, 0.03, 0.02), spacing_m=(0.075, 0.065), toe_in=0.8, fov_x_deg=42.0
        ),
        shadow_sources=_lamp_points(setup),
        depth_range=(0.7, 4.0),
        notes={"turns_per_s": setup.turns_per_s, "disc_radius_m": DISC_RADIUS_M},
    )


# ---------------------------------------------------------------- light

_LAMP_HALF_M = 0.16


def _lamp_frame(setup: _Setup) -> np.ndarray:
    """Pose [4, 4] of the square lamp: its z axis shines on the disc."""
    origin = np.array(setup.lamp)
    forward = np.array([0.0, 0.0, 0.1]) - origin
    forward /= np.linalg.norm(forward)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    frame = np.eye(4)
    frame[:3] = np.stack([left, np.cross(forward, left), forward, origin], 1)
    return frame


def _lamp_points(setup: _Setup) -> np.ndarray:
    """Homogeneous points [5, 4]: the middle and the corners of the lamp."""
    corners = np.array([(0, 0, 0, 1)] + [(a, b, 0, 1) for a in (-1, 1) for b in (-1, 1)], np.float64)
    corners[:, :2] *= _LAMP_HALF_M
    return corners @ _lamp_frame(setup).T


def _emitters(setup: _Setup) -> dict[str, dict[str, Any]]:
    """One square lamp, sampled, and weak light from everywhere that only BSDF sampling finds (less noise)."""
    power = 62.0 * setup.lamp_power
    scale = np.diag([_LAMP_HALF_M, _LAMP_HALF_M, 1.0, 1.0])
    return {
        "lamp": {
            "type": "rectangle",
            "to_world": _lamp_frame(setup) @ scale,
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [power, power * 0.95, power * 0.88]}},
        },
        "room": {"type": "constant", "radiance": {"type": "rgb", "value": [0.40, 0.43, 0.48]}, "sampling_weight": 0.0},
    }


# ---------------------------------------------------------------- the room


def _room(rng: np.random.Generator) -> dict[str, Part]:
    desk = quad((0, 0.05, 0), (2.6, 0, 0), (0, 1.5, 0))
    wall = quad((0, 0.8, 0.75), (3.4, 0, 0), (0, 0, 2.1))
    parts = {
        "desk": Part(desk, Material(wood((640, 1100), rng), 0.25)),
        "wall": Part(
            wall,
            Material(
                paving((384, 640), rng, (32, 32), (0.40, 0.48, 0.52), (0.60, 0.68, 0.70), (0.75, 0.75, 0.72), 0.12)
            ),
        ),
        "skirting": Part(box((3.4, 0.02, 0.06), (0, 0.785, 0.03)), Material((0.62, 0.60, 0.56))),
    }
    parts |= _posters(rng)
    parts |= _desk_things(rng)
    return parts


def _posters(rng: np.random.Generator) -> dict[str, Part]:
    parts = {}
    for k, (x, words) in enumerate(((-0.62, "SPIKE"), (0.0, "4D"), (0.62, "20 kHz"))):
        paper = mix(fractal((150, 210), rng, 40), (0.60, 0.56, 0.44), (0.80, 0.77, 0.66))
        c = Canvas(paper, 500)
        c.rectangle(0.01, 0.01, 0.41, 0.05, _INK[k])
        c.text(words, 0.21, 0.14, 0.065, _INK[k])
        for j in range(5):
            c.rectangle(0.04, 0.215 + 0.015 * j, 0.04 + rng.uniform(0.15, 0.33), 0.222 + 0.015 * j, (0.08, 0.08, 0.1))
        parts[f"poster{k}"] = Part(quad((x, 0.795, 0.26), (0.44, 0, 0), (0, 0, 0.31)), Material(c.picture))
    return parts


def _desk_things(rng: np.random.Generator) -> dict[str, Part]:
    """Books, a mug, pencils, a ball, a ruler, sheets of paper: all away from the disc."""
    books: dict[str, Part] = {}
    x = 0.46
    for k, title in enumerate(("GAUSS", "RADON", "HODGE", "NOETHER", "EULER")):
        thick, tall = rng.uniform(0.035, 0.055), rng.uniform(0.18, 0.25)
        spine = Canvas(plain((160, 40), _BLOCKS[k % 4]) * (0.8 + 0.3 * fractal((160, 40), rng, 16)[..., None]), 160)
        spine.rectangle(0, 0.06, 0.25, 0.09, (0.80, 0.75, 0.6))
        spine.rectangle(0, 0.91, 0.25, 0.94, (0.80, 0.75, 0.6))
        spine.text(title, 0.125, 0.5, 0.12, (0.85, 0.82, 0.72), turn_deg=90)
        books[f"book{k}"] = Part(
            box((thick, 0.16, tall), (x + thick / 2, 0.60, tall / 2)), Material(spine.picture, 0.2)
        )
        x += thick + 0.003
    mug = revolve(np.array([(0.0, 0.006), (0.045, 0.006), (0.047, 0.1), (0.05, 0.1), (0.05, 0.0), (0.0, 0.0)]), 40)
    a = np.linspace(-1.3, 1.3, 12)
    handle = tube(np.stack([0.047 + 0.032 * np.cos(a), 0 * a, 0.05 + 0.033 * np.sin(a)], 1), 0.007, 8)
    bands = cloth((32, 64), rng, [(0.80, 0.78, 0.72), (0.12, 0.28, 0.50)], 8)
    pencils, pot = [], revolve(np.array([(0.04, 0), (0.042, 0.1), (0.038, 0.1), (0.036, 0.005), (0, 0.005)]), 32)
    for k in range(5):
        lean = np.array([0.04 * np.cos(2.5 * k), 0.03 * np.sin(2.5 * k)])
        pencils.append(
            tube(
                [(0, 0, 0.01), (*lean * 0.6, 0.12), (*lean, 0.19), (*lean * 1.05, 0.205)],
                [0.005, 0.005, 0.005, 0.0005],
                6,
            )
        )
    sheet = Canvas(plain((148, 210), (0.80, 0.79, 0.75)), 700)
    for j in range(9):
        sheet.rectangle(0.02, 0.02 + 0.02 * j, 0.02 + rng.uniform(0.15, 0.26), 0.026 + 0.02 * j, (0.1, 0.1, 0.14))
    ruler = Canvas(plain((24, 320), (0.72, 0.60, 0.25)), 1000)
    for j in range(32):
        ruler.rectangle(0.002 + 0.01 * j, 0, 0.0035 + 0.01 * j, 0.014 if j % 5 == 0 else 0.008, (0.05, 0.05, 0.05))
    beach = cloth((48, 120), rng, [(0.75, 0.12, 0.08), (0.80, 0.78, 0.70), (0.10, 0.25, 0.60), (0.80, 0.62, 0.10)], 15)
    stack = [box((0.20, 0.15, 0.03), (-0.62, 0.45, 0.015)), box((0.17, 0.14, 0.03), (-0.61, 0.46, 0.045))]
    return books | {
        "mug": Part(merge([mug, handle]).at(0.60, 0.12, 0), Material(bands, 0.1)),
        "pot": Part(
            pot.at(-0.30, 0.58, 0),
            Material(paving((64, 96), rng, (8, 12), (0.10, 0.12, 0.14), (0.22, 0.25, 0.28)), 0.2),
        ),
        "pencils": Part(merge(pencils).at(-0.30, 0.58, 0), Material((0.75, 0.50, 0.08), 0.2)),
        "ball": Part(
            ellipsoid((0.085, 0.085, 0.085), (0, 0, 0), 40).moved(translation(-0.60, 0.45, 0.145) @ rotation("x", 0.7)),
            Material(beach, 0.12),
        ),
        "stack": Part(merge(stack), Material(wood((48, 96), rng, 3), 0.3)),
        "sheet": Part(quad((-0.50, -0.36, 0.001), (0.29, 0.06, 0), (-0.04, 0.20, 0)), Material(sheet.picture)),
        "ruler": Part(quad((0.50, -0.36, 0.002), (0.30, 0.10, 0), (-0.008, 0.024, 0)), Material(ruler.picture, 0.2)),
        "die": Part(
            box((0.05, 0.05, 0.05), (0, 0, 0.025)).moved(translation(0.36, -0.52, 0) @ rotation("z", 0.5)),
            Material(_die()),
        ),
    }


def _die() -> np.ndarray:
    c = Canvas(plain((48, 48), (0.80, 0.78, 0.72)), 48)
    for x, y in ((0.25, 0.25), (0.75, 0.25), (0.5, 0.5), (0.25, 0.75), (0.75, 0.75)):
        c.ellipse(x, y, 0.1, 0.1, (0.5, 0.05, 0.05))
    return c.picture


# ---------------------------------------------------------------- the disc


def _disc_parts(setup: _Setup, rng: np.random.Generator) -> tuple[Part, ...]:
    """Everything that spins: the lettered top, the striped edge, a hub, blocks, a pawn, a cone and a ring."""
    stripes = mix(((np.arange(512) // 8) % 2)[None] * np.ones((6, 1)), (0.06, 0.06, 0.07), (0.80, 0.79, 0.75))
    edge = revolve(np.array([(DISC_RADIUS_M, 0.004), (DISC_RADIUS_M, DISC_TOP_M)]), 128)
    collar = revolve(
        np.array(
            [
                (DISC_RADIUS_M, DISC_TOP_M),
                (DISC_RADIUS_M - 0.004, DISC_TOP_M + 0.003),
                (DISC_RADIUS_M - 0.010, DISC_TOP_M),
            ]
        ),
        128,
    )
    hub = np.array(
        [
            (0.052, 0),
            (0.052, 0.012),
            (0.036, 0.018),
            (0.030, 0.055),
            (0.036, 0.062),
            (0.030, 0.075),
            (0.014, 0.085),
            (0, 0.087),
        ]
    )
    parts = [
        Part(disc(DISC_RADIUS_M - 0.006, DISC_TOP_M, 128), Material(_top_picture(setup, rng), 0.3)),
        Part(edge, Material(stripes)),
        Part(collar, Material((0.72, 0.70, 0.64), 0.2)),
        Part(revolve(hub, 48).at(0, 0, DISC_TOP_M), Material((0.78, 0.76, 0.70), 0.25, metal=True)),
    ]
    for k, colour in enumerate(_BLOCKS[:3]):
        angle = 2 * np.pi * (k / 3 + 0.06)
        size = (0.066, 0.058, 0.072)[k]
        block = box((size, size, size), (0, 0, DISC_TOP_M + size / 2)).moved(rotation("z", 0.4 + k))
        at = translation(0.165 * np.cos(angle), 0.165 * np.sin(angle), 0)
        parts.append(Part(block.moved(at), Material(_block_picture("XYZ"[k], colour, rng), 0.25)))
    parts += _small_things(rng)
    return tuple(parts)


def _small_things(rng: np.random.Generator) -> list[Part]:
    """A pawn, a cone and a striped post between the blocks."""

    def around(mesh: Mesh, turn: float) -> Mesh:
        return mesh.at(0.17 * np.cos(2 * np.pi * turn), 0.17 * np.sin(2 * np.pi * turn), DISC_TOP_M)

    pawn = revolve(
        np.array(
            [
                (0.030, 0),
                (0.030, 0.008),
                (0.018, 0.018),
                (0.011, 0.050),
                (0.019, 0.056),
                (0.010, 0.060),
                (0.017, 0.068),
                (0.019, 0.078),
                (0.013, 0.092),
                (0, 0.096),
            ]
        ),
        32,
    )
    cone = revolve(np.array([(0.036, 0), (0.036, 0.006), (0.028, 0.006), (0.006, 0.085), (0, 0.086)]), 32)
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


def _top_picture(setup: _Setup, rng: np.random.Generator) -> np.ndarray:
    """Sectors, letters that read from the rim inwards, a tick scale and a dark middle with a hand."""
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
        c.text(letter, *polar(0.245, angle), 0.068, _INK[(k + setup.first_letter) % 4], np.degrees(angle) - 90)
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
    return c.picture * (0.86 + 0.18 * fractal((n, n), rng, 64, 2))[..., None]


def _block_picture(letter: str, colour: Colour, rng: np.random.Generator) -> np.ndarray:
    """A toy block's face: a coloured frame around a light field with a letter."""
    c = Canvas(plain((96, 96), colour) * (0.85 + 0.25 * fractal((96, 96), rng, 24)[..., None]), 96)
    c.rectangle(0.13, 0.13, 0.87, 0.87, (0.80, 0.76, 0.66))
    c.text(letter, 0.5, 0.5, 0.50, tuple(0.5 * v for v in colour))
    return c.picture


WORLD = World("turntable", "Letters and blocks on a spinning disc", build)
