"""The static garden around the bird: a wooden deck, a brick wall with ivy, pots with flowers, a can, a fence."""

from __future__ import annotations

import numpy as np

from spike4dgs.generators.worlds.base import Part, RigSpec
from spike4dgs.generators.worlds.meshes import Mesh, box, ellipsoid, merge, quad, revolve, tube
from spike4dgs.generators.worlds.surfaces import Material
from spike4dgs.generators.worlds.textures import Canvas, fractal, mix, paving, plain, wood

WALL_Y = 1.15
RIG = RigSpec(
    center=(0.05, -0.98, 0.98), target=(0.0, 0.06, 0.42), spacing_m=(0.085, 0.072), toe_in=0.8, fov_x_deg=45.0
)
_POTS = ((-0.78, 0.62, 0.15), (-0.38, 0.86, 0.11), (0.46, 0.78, 0.13), (0.88, 0.56, 0.16), (-1.2, 0.80, 0.13))


def garden(rng: np.random.Generator) -> dict[str, Part]:
    """Return all static surfaces, name -> part."""
    deck = quad((0, 0.0, 0), (4.4, 0, 0), (0, 2.6, 0))
    wall = quad((0, WALL_Y, 0.9), (4.6, 0, 0), (0, 0, 1.8))
    bricks = paving((360, 920), rng, (15, 46), (0.36, 0.15, 0.09), (0.58, 0.30, 0.20), (0.46, 0.43, 0.38), 0.3, gap=2)
    ledge = box((4.6, 0.16, 0.06), (0, WALL_Y - 0.05, 0.60), 1.5)
    lawn = quad((0, 0, -0.02), (60, 0, 0), (0, 60, 0))
    sign = Canvas(plain((110, 240), (0.30, 0.42, 0.40)), 400)
    sign.rectangle(0.012, 0.012, 0.588, 0.263, (0.80, 0.77, 0.68))
    sign.text("GARDEN", 0.30, 0.10, 0.075, (0.08, 0.22, 0.12))
    sign.text("20 kHz", 0.30, 0.20, 0.05, (0.55, 0.10, 0.05))
    return {
        "deck": Part(deck, Material(1.3 * wood((620, 1050), rng, 17), 0.4)),
        "wall": Part(wall, Material(bricks)),
        "ledge": Part(ledge, Material(paving((64, 64), rng, (32, 64), (0.50, 0.48, 0.44), (0.66, 0.64, 0.60)))),
        "lawn": Part(lawn, Material((0.10, 0.16, 0.05))),
        "sign": Part(quad((0.02, WALL_Y - 0.01, 0.34), (0.60, 0, 0), (0, 0, 0.275)), Material(sign.image)),
        **_plants(rng),
        **_objects(rng),
    }


def _plants(rng: np.random.Generator) -> dict[str, Part]:
    """Return pots with soil, leaves and flowers, and ivy on the wall."""
    pot = np.array(
        [(0.0, 0.0), (0.68, 0.0), (0.92, 0.86), (1.0, 0.88), (1.0, 1.0), (0.90, 1.0), (0.86, 0.88), (0.0, 0.88)]
    )
    pots, leaves, blossoms = [], [], []
    for x, y, r in _POTS:
        pots.append(revolve(pot * [r, 1.35 * r], 28).at(x, y, 0))
        for _ in range(34):
            a, tilt = rng.uniform(0, 2 * np.pi), rng.uniform(0.25, 1.2)
            way = np.array([np.cos(a) * np.sin(tilt), np.sin(a) * np.sin(tilt), np.cos(tilt)])
            leaves.append(
                _leaf(np.array([x, y, 1.25 * r]) + 0.3 * r * way * [1, 1, 0], way, rng.uniform(1.0, 1.9) * r, rng)
            )
        for _ in range(11):
            a, d = rng.uniform(0, 2 * np.pi), r * rng.uniform(0.1, 1.0)
            size = rng.uniform(0.022, 0.036)
            ball = ellipsoid(
                (size, size, 0.7 * size), (x + d * np.cos(a), y + d * np.sin(a), r * rng.uniform(2.0, 2.9)), 10
            )
            blossoms.append(Mesh(ball.vertices, ball.faces, ball.uv * 0 + [(len(pots) - 0.5) / len(_POTS), 0.5], True))
    for _ in range(230):
        x = rng.choice([-1.5, 0.62, 1.5]) + rng.normal(0, 0.26)
        z = abs(rng.normal(0, 0.55)) + 0.03
        way = np.array([rng.normal(0, 0.6), -0.55, rng.normal(-0.4, 0.4)])
        leaves.append(_leaf(np.array([x, WALL_Y - 0.012, z]), way / np.linalg.norm(way), rng.uniform(0.06, 0.11), rng))
    petals = np.float32(
        [[(0.78, 0.07, 0.10), (0.82, 0.62, 0.06), (0.80, 0.78, 0.74), (0.62, 0.16, 0.48), (0.80, 0.32, 0.05)]]
    )
    green = mix(fractal((64, 64), rng, 8, 1), (0.03, 0.10, 0.015), (0.20, 0.38, 0.07))
    clay = mix(fractal((96, 192), rng, 24, 1), (0.42, 0.19, 0.10), (0.66, 0.36, 0.22))
    return {
        "pots": Part(merge(pots), Material(clay)),
        "leaves": Part(merge(leaves), Material(green, 0.4)),
        "flowers": Part(merge(blossoms), Material(np.repeat(np.repeat(petals, 8, 0), 8, 1))),
    }


def _leaf(root: np.ndarray, way: np.ndarray, length: float, rng: np.random.Generator) -> Mesh:
    """Return a pointed leaf of six triangles, bent downwards."""
    side = np.cross(way, [0.0, 0.0, 1.0]) + 1e-6
    side *= 0.22 * length / np.linalg.norm(side)
    sag = np.array([0, 0, -0.25 * length])
    spine = [root, root + 0.4 * length * way, root + 0.75 * length * way + 0.4 * sag, root + length * way + sag]
    points = np.array(
        [spine[0], spine[1] - side, spine[1] + side, spine[2] - 0.8 * side, spine[2] + 0.8 * side, spine[3]]
    )
    faces = np.array([[0, 1, 2], [1, 3, 4], [1, 4, 2], [3, 5, 4]])
    uv = np.array([(0.5, 1), (0.2, 0.6), (0.8, 0.6), (0.3, 0.3), (0.7, 0.3), (0.5, 0)]) + rng.random(2)
    return Mesh(points, faces, uv, smooth=False)


def _objects(rng: np.random.Generator) -> dict[str, Part]:
    """Return a watering can, a bowl and a post with a lantern."""
    can = revolve([(0.0, 0.0), (0.11, 0.0), (0.11, 0.16), (0.085, 0.20), (0.04, 0.21), (0.0, 0.21)], 28)
    spout = tube([(0.09, 0, 0.06), (0.22, 0, 0.19), (0.26, 0, 0.21)], [0.022, 0.016, 0.03], 12)
    a = np.linspace(0.2, np.pi - 0.2, 14)
    handle = tube(np.stack([-0.10 * np.cos(a), 0 * a, 0.15 + 0.15 * np.sin(a)], 1), 0.011, 8)
    bowl = revolve([(0.0, 0.012), (0.10, 0.02), (0.135, 0.07), (0.15, 0.07), (0.12, 0.0), (0.0, 0.0)], 32)
    stripes = mix(((np.arange(64) // 8) % 2)[:, None] * np.ones((1, 8)), (0.10, 0.20, 0.42), (0.80, 0.79, 0.75))
    post = [box((0.07, 0.07, 0.52), (1.28, 0.30, 0.26)), box((0.16, 0.16, 0.03), (1.28, 0.30, 0.535))]
    return {
        "can": Part(merge([can, spout, handle]).at(-1.02, 0.22, 0), Material((0.16, 0.36, 0.34), 0.2)),
        "bowl": Part(bowl.at(0.45, 0.30, 0), Material(stripes)),
        "post": Part(merge(post), Material(wood((96, 48), rng, 2))),
        "lantern": Part(ellipsoid((0.06, 0.06, 0.08), (1.28, 0.30, 0.63), 20), Material((0.80, 0.72, 0.50), 0.15)),
    }
