"""World `chips`: a handful of gaming chips falls on a felt table and scatters. Rigid bodies by MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Deforming, Part, RigSpec, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import Mesh, box, merge, quad, revolve
from spike4dgs.generators.worlds.parts import desk
from spike4dgs.generators.worlds.parts.rigid_bodies import GRAVITY_M_S2, Block, Body, owners, simulate
from spike4dgs.generators.worlds.surfaces import Colour, Lamp, Material
from spike4dgs.generators.worlds.textures import Canvas, fractal, mix, plain

RADIUS_M, THICK_M = 0.024, 0.0045
_SEGMENTS = 28
_BEFORE_S = 0.05  # of simulated fall before the middle of the clip
_SLOWEST_M_S = 0.3  # of fall when it begins
_FLOOR_M = -0.01
_CELL = 112  # texels of a chip's face
_COLOURS: tuple[Colour, ...] = (
    (0.70, 0.06, 0.05),
    (0.05, 0.16, 0.55),
    (0.06, 0.38, 0.14),
    (0.05, 0.05, 0.06),
    (0.72, 0.45, 0.04),
    (0.36, 0.08, 0.42),
)
_VALUES = ("5", "10", "25", "100", "500", "1k")
_WHITE: Colour = (0.84, 0.82, 0.76)


@dataclass(frozen=True)
class _Throw:
    """The random choices of a variant; the defaults are those of variant 0."""

    count: int = 48
    speed_m_s: float = 2.6  # of fall in the middle of the clip, at least
    drift_m_s: float = 0.5
    felt: Colour = (0.045, 0.22, 0.10)
    lamp: Lamp = Lamp((0.70, -0.70, 1.6), 0.95)


def _sample(variant: int, rng: np.random.Generator) -> _Throw:
    if variant == 0:
        return _Throw()
    side = rng.choice([-1.0, 1.0])
    lamp = Lamp((side * rng.uniform(0.4, 0.9), rng.uniform(-0.9, -0.5), rng.uniform(1.4, 1.8)), rng.uniform(0.85, 1.0))
    felt = ((0.045, 0.22, 0.10), (0.06, 0.10, 0.28), (0.28, 0.05, 0.06))[int(rng.integers(3))]
    return _Throw(int(rng.integers(40, 61)), rng.uniform(2.2, 3.2), rng.uniform(-0.8, 0.8), felt, lamp)


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. Most chips are in the air at half of `duration_s`; the lowest have bounced."""
    rng = rng_for("chips", seed, variant)
    throw = _sample(variant, rng)
    start_s = min(0.0, duration_s / 2 - _BEFORE_S)
    blocks = [Block.around(mesh) for mesh in _edges()]
    fall_s = duration_s / 2 - start_s
    path = simulate(_bodies(throw, fall_s, rng), start_s, duration_s, friction=0.3, blocks=blocks)
    chips = [_chip(int(kind)) for kind in rng.integers(0, len(_COLOURS), throw.count)]
    mesh, (owner, bodies) = merge(chips), owners(chips)
    surface = Part(mesh, Material(_image(rng), 0.3))
    return WorldScene(
        duration_s=duration_s,
        static=_table(throw.felt, rng),
        groups={},
        instances={},
        emitters=throw.lamp.emitters(),
        poses=lambda t_s: {},
        exposure=1.5,
        rig=RigSpec(
            center=(0.0, -0.78, 0.60), target=(0.0, 0.04, 0.135), spacing_m=(0.055, 0.048), toe_in=0.8, fov_x_deg=39.0
        ),
        shadow_sources=throw.lamp.points,
        depth_range=(0.2, 4.0),
        notes={
            "speed_m_s": max(throw.speed_m_s, _SLOWEST_M_S + GRAVITY_M_S2 * fall_s),
            "length_m": 2 * RADIUS_M,
            "chips": float(throw.count),
        },
        deforming={"chip": Deforming(surface, lambda t_s: path.vertices(t_s, mesh.vertices, owner), bodies)},
    )


def _bodies(throw: _Throw, fall_s: float, rng: np.random.Generator) -> list[Body]:
    """Return chips that free flight would spread over a column `fall_s` later, without overlap at either end.

    Chips whose paths cross collide on the way, and the lowest meet the table.
    """
    speed = throw.speed_m_s - GRAVITY_M_S2 * fall_s
    apart = 2.02 * np.hypot(RADIUS_M, THICK_M / 2)  # enough at every orientation
    accepted: list[np.ndarray] = []  # [2, 3]: at the beginning and at the end
    bodies: list[Body] = []
    while len(bodies) < throw.count:
        position = np.array([rng.normal(0, 0.10), rng.normal(0.02, 0.07), rng.uniform(0.01, 0.34)])
        down = max(speed + rng.uniform(-0.3, 0.3), _SLOWEST_M_S)
        velocity = np.array([throw.drift_m_s + rng.normal(0, 0.25), rng.normal(0, 0.25), -down])
        begin = position - velocity * fall_s + [0, 0, GRAVITY_M_S2 / 2 * fall_s**2]
        ends = np.stack([begin, position])
        if any(np.linalg.norm(ends - other, axis=1).min() < apart for other in accepted):
            continue
        accepted.append(ends)
        q, spin = rng.normal(size=4), rng.normal(0, 22, 3)
        q /= np.linalg.norm(q)
        size = (RADIUS_M, THICK_M / 2)
        motion = {"velocity": tuple(velocity.tolist()), "spin": tuple(spin.tolist())}
        bodies.append(Body("cylinder", size, tuple(begin.tolist()), tuple(q.tolist()), **motion, density=1800.0))
    return bodies


def _chip(kind: int) -> Mesh:
    """Return a chip about the origin, axis along z; column `kind` of the image has its colours, face above edge."""
    a = np.linspace(0, 2 * np.pi, _SEGMENTS, endpoint=False)
    h, r, n = THICK_M / 2, RADIUS_M, len(_COLOURS)
    rows = _CELL + 16
    circle = np.stack([np.cos(a), np.sin(a)], 1)
    parts = []
    for side in (-1.0, 1.0):
        points = np.concatenate([np.column_stack([r * circle, np.full(_SEGMENTS, side * h)]), [[0, 0, side * h]]])
        flat = np.concatenate([circle * [side, 1.0], [[0, 0]]])  # the print of both faces reads from outside
        uv = np.stack([(kind + 0.5 + 0.48 * flat[:, 0]) / n, (0.5 - 0.48 * flat[:, 1]) * _CELL / rows], 1)
        i = np.arange(_SEGMENTS)
        faces = np.stack([i, (i + 1) % _SEGMENTS, np.full(_SEGMENTS, _SEGMENTS)], 1)
        parts.append(Mesh(points, faces, uv, smooth=False))
    rim = revolve([(r, -h), (r, h)], _SEGMENTS)
    v = (_CELL + 3 + 10 * rim.uv[:, 1]) / rows
    parts.append(Mesh(rim.vertices, rim.faces, np.stack([(kind + 0.03 + 0.94 * rim.uv[:, 0]) / n, v], 1), smooth=False))
    return merge(parts)


def _image(rng: np.random.Generator) -> np.ndarray:
    """Return the faces with a value, a ring and edge spots; below them, the stripes of the edges."""
    n = len(_COLOURS)
    c = Canvas(plain((_CELL + 16, n * _CELL), (0.5, 0.5, 0.5)), _CELL)
    for k, (colour, value) in enumerate(zip(_COLOURS, _VALUES, strict=True)):
        x = k + 0.5
        c.rectangle(k, 0, k + 1, 1.2, colour)
        for spot in range(8):
            a = 2 * np.pi * spot / 8
            wedge = [
                (x + r * np.cos(a + d), 0.5 + r * np.sin(a + d))
                for r, d in ((0.36, -0.22), (0.5, -0.2), (0.5, 0.2), (0.36, 0.22))
            ]
            c.polygon(wedge, _WHITE)
            c.rectangle(k + spot / 8, 1.0, k + spot / 8 + 0.05, 1.2, _WHITE)
        c.ellipse(x, 0.5, 0.33, 0.33, _WHITE)
        c.ellipse(x, 0.5, 0.30, 0.30, colour)
        c.ellipse(x, 0.5, 0.25, 0.25, (0.80, 0.76, 0.64))
        c.text(value, x, 0.5, 0.20 if len(value) < 3 else 0.15, (0.04, 0.04, 0.05))
    return np.asarray(c.image * (0.92 + 0.12 * fractal(c.image.shape[:2], rng, 16, 1))[..., None])


def _table(felt: Colour, rng: np.random.Generator) -> dict[str, Part]:
    """Return a felt table with printed fields and a wooden edge, and the room's wall and posters behind it."""
    size = (780, 1300)
    cloth = mix(fractal(size, rng, 64, 1), tuple(0.75 * v for v in felt), tuple(1.25 * v for v in felt))
    cloth *= (0.85 + 0.3 * rng.random(size, dtype=np.float32))[..., None]
    c = Canvas(cloth, 1000)
    for radius in (0.30, 0.29):
        c.ellipse(0.65, 0.40, radius, radius * 0.72, (0.80, 0.74, 0.50) if radius == 0.30 else felt)
    c.text("SPIKE", 0.65, 0.36, 0.085, (0.80, 0.74, 0.50))
    c.text("20 000 Hz", 0.65, 0.47, 0.040, (0.80, 0.74, 0.50))
    for k in range(10):
        x = 0.10 + 0.122 * k
        c.rectangle(x, 0.66, x + 0.11, 0.75, (0.80, 0.74, 0.50))
        c.rectangle(x + 0.005, 0.665, x + 0.105, 0.745, (0.50, 0.05, 0.05) if k % 2 else (0.04, 0.04, 0.05))
        c.text(str(7 * k % 36), x + 0.055, 0.705, 0.035, _WHITE)
    image = c.image * (0.88 + 0.16 * fractal(size, rng, 8, 1))[..., None]
    room = desk.room(rng)
    return {k: room[k] for k in ("wall", "poster0", "poster1", "poster2")} | {
        "skirting": Part(room["skirting"].mesh.at(0, 0, _FLOOR_M), room["skirting"].material),
        "floor": Part(quad((0, 0.0, _FLOOR_M), (3.4, 0, 0), (0, 2.4, 0)), room["desk"].material),
        "felt": Part(quad((0, 0.05, 0), (1.3, 0, 0), (0, 0.78, 0)), Material(image)),
        "edge": Part(merge(_edges()), Material((0.30, 0.14, 0.06), 0.2)),
    }


def _edges() -> list[Mesh]:
    """Return the table's far and near edge."""
    return [box((1.36, 0.03, 0.03), (0, y, 0.0)) for y in (0.455, -0.355)]


WORLD = World("chips", "A handful of chips falls on a table", build)
