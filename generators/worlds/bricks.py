"""World `bricks`: a ball bursts a wall of toy bricks on a desk. Rigid bodies by MuJoCo, one step per tick."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Deforming, Part, RigSpec, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import Mesh, ellipsoid, merge, quad
from spike4dgs.generators.worlds.parts import desk
from spike4dgs.generators.worlds.parts.rigid_bodies import GRAVITY_M_S2, Block, Body, owners, simulate
from spike4dgs.generators.worlds.surfaces import Colour, Lamp, Material
from spike4dgs.generators.worlds.textures import Canvas, cloth, fractal, plain

BRICK_M = (0.084, 0.044, 0.040)  # x, y, z
COLUMNS, ROWS = 6, 8
BALL_M = 0.042
_WALL_Y = 0.02
_AFTER_IMPACT_S = 0.035  # the middle of the clip
_FLIGHT_S = 0.002  # simulated flight of the ball before it meets the wall; earlier motion needs no simulation
_DESCENT_M_S = 1.2  # of the ball at the wall; its arc stays above the table for longer than any clip
_TEXELS = 900  # per metre of the painted front
_CELL = 24  # texels of a brick's own colour

_PAINTS: tuple[tuple[Colour, ...], ...] = (
    ((0.68, 0.16, 0.08), (0.74, 0.40, 0.06), (0.70, 0.58, 0.14), (0.58, 0.11, 0.07)),
    ((0.10, 0.30, 0.52), (0.16, 0.46, 0.50), (0.30, 0.36, 0.62), (0.08, 0.20, 0.40)),
    ((0.20, 0.46, 0.16), (0.48, 0.54, 0.12), (0.12, 0.34, 0.20), (0.66, 0.60, 0.20)),
)
# Height of the letters in metres, such that the word fits on whole bricks.
_WORDS = {"SPIKE": 0.100, "GAUSS": 0.087, "20KHZ": 0.088, "BRICK": 0.095}


@dataclass(frozen=True)
class _Shot:
    """The random choices of a variant; the defaults are those of variant 0."""

    speed_m_s: float = 13.0
    aim: tuple[float, float] = (-0.03, 0.17)  # x and z where the ball hits
    heading_deg: float = 62.0  # of the ball, from +x
    paint: int = 0
    word: str = "SPIKE"
    lamp: Lamp = Lamp((-0.75, -0.85, 1.55), 0.95)


def _sample(variant: int, rng: np.random.Generator) -> _Shot:
    if variant == 0:
        return _Shot()
    lamp = Lamp(
        (rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 0.9), rng.uniform(-0.95, -0.6), rng.uniform(1.4, 1.8)),
        rng.uniform(0.85, 1.0),
    )
    aim, heading = (rng.uniform(-0.10, 0.10), rng.uniform(0.11, 0.24)), rng.uniform(50, 125)
    word = list(_WORDS)[int(rng.integers(len(_WORDS)))]
    return _Shot(rng.uniform(11.0, 16.0), aim, heading, int(rng.integers(len(_PAINTS))), word, lamp)


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. The ball meets the wall 35 ms before half of `duration_s`; simulation begins 2 ms earlier."""
    rng = rng_for("bricks", seed, variant)
    shot = _sample(variant, rng)
    start_s = duration_s / 2 - _AFTER_IMPACT_S - _FLIGHT_S
    positions, ball, static = _positions(), _ball(shot), _room(rng)
    bodies = [Body("box", tuple(v / 2 for v in BRICK_M), p, density=650.0) for p in positions]
    path = simulate([*bodies, ball], start_s, duration_s, blocks=_blocks(static))
    meshes, image = _bricks(positions, shot, rng)
    mesh, (owner, bodies_of_faces) = merge(meshes), owners(meshes)

    def ball_pose(t_s: float) -> dict[str, np.ndarray]:
        if t_s < start_s:
            return {"ball": ball.flight(t_s - start_s)}
        turn, shift = path.at(t_s)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn[-1], shift[-1]
        return {"ball": pose}

    stripes = cloth((48, 96), rng, [(0.80, 0.78, 0.72), (0.08, 0.16, 0.42)], 12)
    return WorldScene(
        duration_s=duration_s,
        static=static,
        groups={"ball": (Part(ellipsoid((BALL_M,) * 3, (0, 0, 0), 40), Material(stripes, 0.12)),)},
        instances={"ball": "ball"},
        emitters=shot.lamp.emitters(),
        poses=ball_pose,
        exposure=1.55,
        rig=RigSpec(
            center=(-0.22, -0.98, 0.62), target=(0.0, 0.05, 0.13), spacing_m=(0.07, 0.06), toe_in=0.8, fov_x_deg=39.0
        ),
        shadow_sources=shot.lamp.points,
        depth_range=(0.35, 4.0),
        notes={"speed_m_s": shot.speed_m_s, "length_m": 2 * BALL_M, "brick_length_m": BRICK_M[0]},
        deforming={
            "brick": Deforming(
                Part(mesh, Material(image, 0.35)),
                lambda t_s: path.vertices(t_s, mesh.vertices, owner),
                bodies_of_faces,
            )
        },
    )


def _positions() -> list[tuple[float, float, float]]:
    """Return the centres of the bricks in running bond; every other row is half a brick to the side."""
    w, _, h = BRICK_M
    return [
        ((k - (COLUMNS - 1) / 2 + (0.25 if row % 2 else -0.25)) * w, _WALL_Y, (row + 0.5) * h)
        for row in range(ROWS)
        for k in range(COLUMNS)
    ]


def _ball(shot: _Shot) -> Body:
    """Return the ball at a position from which it touches the wall's front after _FLIGHT_S, its fall included."""
    a = np.radians(shot.heading_deg)
    velocity = np.array([*(shot.speed_m_s * np.array([np.cos(a), np.sin(a)])), -_DESCENT_M_S])
    touch = np.array([shot.aim[0], _WALL_Y - BRICK_M[1] / 2 - BALL_M, shot.aim[1]])
    begin = touch - velocity * _FLIGHT_S + [0.0, 0.0, GRAVITY_M_S2 / 2 * _FLIGHT_S**2]
    spin = (8.0, 0.0, 20.0)
    return Body(
        "sphere", (BALL_M,), tuple(begin.tolist()), velocity=tuple(velocity.tolist()), spin=spin, density=2600.0
    )


def _room(rng: np.random.Generator) -> dict[str, Part]:
    """Return the desk without the objects that lie where bricks fly."""
    away = ("pot", "pencils", "mug", "die", "sheet", "ruler", "ball", "stack")
    return {name: part for name, part in desk.room(rng).items() if name not in away}


def _blocks(room: dict[str, Part]) -> list[Block]:
    """Return the obstacles for bricks, none of which moves: the room's wall (made thick enough), skirting, books."""
    books = [Block.around(part.mesh) for name, part in room.items() if name.startswith("book")]
    wall = Block.around(room["wall"].mesh)
    front = min(Block.around(room[name].mesh).low[1] for name in ("poster0", "wall"))
    behind = Block((wall.low[0], front, wall.low[2]), (wall.high[0], front + 0.2, wall.high[2]))
    return [behind, Block.around(room["skirting"].mesh), *books]


# ---------------------------------------------------------------- bricks


def _bricks(
    positions: list[tuple[float, float, float]], shot: _Shot, rng: np.random.Generator
) -> tuple[list[Mesh], np.ndarray]:
    """Return one box for each brick, in its own coordinates, and their image: the painted front, then a cell each."""
    paints = rng.integers(0, 4, len(positions))
    colours = [np.array(_PAINTS[shot.paint][int(k)]) * rng.uniform(0.8, 1.2) for k in paints]
    width, height = (COLUMNS + 0.5) * BRICK_M[0], ROWS * BRICK_M[2]
    front_h, front_w = (int(np.ceil(v * _TEXELS - 1e-9)) for v in (height, width))
    per_row = front_w // _CELL
    cell_rows = -(-len(positions) // per_row)
    image = plain((front_h + cell_rows * _CELL, front_w), (0.3, 0.3, 0.3))
    c = Canvas(image, _TEXELS)
    for (x, _, z), colour in zip(positions, colours, strict=True):
        left, top = x + width / 2 - BRICK_M[0] / 2, height - z - BRICK_M[2] / 2
        c.rectangle(left, top, left + BRICK_M[0], top + BRICK_M[2], tuple(colour))
    c.text(shot.word, width / 2 + 0.003, height / 2 + 0.003, _WORDS[shot.word], (0.84, 0.82, 0.76))
    c.text(shot.word, width / 2, height / 2, _WORDS[shot.word], (0.04, 0.05, 0.09))
    for x, _, z in positions:  # an edge around every brick
        left, top = x + width / 2 - BRICK_M[0] / 2, height - z - BRICK_M[2] / 2
        c.line([(left, top), (left + BRICK_M[0], top)], 0.003, (0.78, 0.74, 0.66), 0.7)
        c.line([(left, top), (left, top + BRICK_M[2])], 0.003, (0.15, 0.12, 0.10), 0.7)
    image = c.image
    meshes = []
    for k, ((x, _, z), colour) in enumerate(zip(positions, colours, strict=True)):
        row, column = divmod(k, per_row)
        y0, x0 = front_h + row * _CELL, column * _CELL
        image[y0 : y0 + _CELL, x0 : x0 + _CELL] = colour
        corner = np.array([x + width / 2 - BRICK_M[0] / 2, height - z - BRICK_M[2] / 2]) * _TEXELS
        front = (corner, np.array([BRICK_M[0], BRICK_M[2]]) * _TEXELS)
        own = (np.array([x0 + 2.0, y0 + 2.0]), np.full(2, _CELL - 4.0))
        meshes.append(_brick(front, own, np.array(image.shape[1::-1], np.float64)))
    image *= (0.86 + 0.22 * fractal(image.shape[:2], rng, 32, 1))[..., None]
    return meshes, image


def _brick(front: tuple[np.ndarray, np.ndarray], own: tuple[np.ndarray, np.ndarray], size: np.ndarray) -> Mesh:
    """Return a box about the origin: its front face shows one rectangle (corner, extent, texels), the rest another."""
    sx, sy, sz = BRICK_M
    faces = [
        ((0, -sy / 2, 0), (sx, 0, 0), (0, 0, sz), front),
        ((0, sy / 2, 0), (-sx, 0, 0), (0, 0, sz), own),
        ((sx / 2, 0, 0), (0, sy, 0), (0, 0, sz), own),
        ((-sx / 2, 0, 0), (0, -sy, 0), (0, 0, sz), own),
        ((0, 0, sz / 2), (sx, 0, 0), (0, sy, 0), own),
        ((0, 0, -sz / 2), (sx, 0, 0), (0, -sy, 0), own),
    ]
    sides = []
    for centre, right, up, (corner, extent) in faces:
        side = quad(centre, right, up)
        sides.append(Mesh(side.vertices, side.faces, (corner + side.uv * extent) / size, smooth=False))
    return merge(sides)


WORLD = World("bricks", "A ball bursts a wall of toy bricks", build)
