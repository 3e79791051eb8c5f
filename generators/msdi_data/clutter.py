"""Training-only worlds: clutter of textured bodies that fall, fly or spin before random walls.

A network that learns from the benchmark's worlds alone may learn streets and desks. Here nothing has a meaning: shapes,
sizes, surfaces, walls, light and motion are drawn at random. These worlds are never in the benchmark.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from spike4dgs.generators.worlds.base import Part, RigSpec, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import Mesh, box, ellipsoid, merge, quad, revolve, rotation, translation, tube
from spike4dgs.generators.worlds.parts import street
from spike4dgs.generators.worlds.parts.rigid_bodies import GRAVITY_M_S2, rotations
from spike4dgs.generators.worlds.surfaces import Material
from spike4dgs.generators.worlds.textures import Canvas, cloth, fractal, mix, paving, wood

_CELL = 128  # texels of a side of a body's image
_ROW = 4  # images of a row and of a column: all bodies share one image, hence one mesh and one material in the renderer
_TARGET = (0.0, 0.0, 0.8)
_WALL_TEXELS = 640
_WORDS = ("ARC", "42", "NOVA", "Q7", "delta", "9.81", "FOX", "x+y", "MUON", "365")


@dataclass(frozen=True, eq=False)
class Path:
    """Free motion of a body: where it is at time 0, and its velocity, spin (m/s, rad/s, world axes) and fall."""

    turn: np.ndarray  # [3, 3] at time 0
    position: np.ndarray  # [3] at time 0
    velocity: np.ndarray
    spin: np.ndarray
    falls: bool = False

    def at(self, t_s: float) -> np.ndarray:
        """Return the pose [4, 4], local to world."""
        rate = float(np.linalg.norm(self.spin))
        axis = self.spin / max(rate, 1e-12)
        half = rate * t_s / 2
        pose = np.eye(4)
        pose[:3, :3] = rotations(np.array([[np.cos(half), *(np.sin(half) * axis)]]))[0] @ self.turn
        pose[:3, 3] = self.position + self.velocity * t_s
        if self.falls:
            pose[2, 3] -= GRAVITY_M_S2 / 2 * t_s**2
        return pose


def _falling(rng: np.random.Generator, path: Path) -> Path:
    velocity = np.array([*rng.normal(0, 0.5, 2), -rng.uniform(0.5, 4.0)])
    return replace(path, velocity=velocity, spin=rng.normal(0, 8, 3), falls=True)


def _flying(rng: np.random.Generator, path: Path) -> Path:
    heading = rng.uniform(0, 2 * np.pi)
    speed = np.exp(rng.uniform(np.log(0.3), np.log(8.0)))
    velocity = speed * np.array([np.cos(heading), 0.5 * np.sin(heading), rng.uniform(-0.3, 0.3)])
    return replace(path, velocity=velocity, spin=rng.normal(0, 5, 3))


def _spinning(rng: np.random.Generator, path: Path) -> Path:
    axis = rng.normal(size=3)
    return replace(path, spin=axis / np.linalg.norm(axis) * np.exp(rng.uniform(np.log(2.0), np.log(60.0))))


def texture(size: int, rng: np.random.Generator) -> np.ndarray:
    """Return a random image [size, size, 3] of reflectance."""
    shape = (size, size)
    a, b = rng.uniform(0.03, 0.85, (2, 3)).tolist()
    kind = int(rng.integers(6))
    if kind == 0:
        return mix(fractal(shape, rng, size / rng.uniform(2, 16), 2, rng.uniform(0.5, 0.9)), a, b)
    if kind == 1:
        stone = rng.integers(size // 32 + 2, size // 4, 2)
        return paving(
            shape, rng, (int(stone[0]), int(stone[1])), a, b, rng.uniform(0.02, 0.7, 3).tolist(), rng.uniform(0.1, 0.4)
        )
    if kind == 2:
        return cloth(
            shape, rng, [a, b, rng.uniform(0.03, 0.85, 3).tolist()], int(rng.integers(size // 40 + 2, size // 5))
        )
    if kind == 3:
        return wood(shape, rng, int(rng.integers(2, 9)))
    if kind == 4:
        spots = fractal(shape, rng, size / rng.uniform(6, 30), 2, 0.4) > rng.uniform(0.35, 0.65)
        return mix(spots.astype(np.float32), a, b) * (0.85 + 0.3 * fractal(shape, rng, 16, 1))[..., None]
    return _drawing(
        mix(fractal(shape, rng, size / 3, 4), a, [0.7 * x + 0.3 * y for x, y in zip(a, b, strict=True)]), size, rng
    )


def _drawing(paper: np.ndarray, size: int, rng: np.random.Generator) -> np.ndarray:
    canvas = Canvas(paper, size)
    for _ in range(int(rng.integers(6, 30))):
        colour, (x, y) = rng.uniform(0.02, 0.9, 3).tolist(), rng.uniform(0, 1, 2).tolist()
        kind, reach = int(rng.integers(3)), rng.uniform(0.03, 0.2)
        if kind == 0:
            angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 7))))
            canvas.polygon(np.stack([x + reach * np.cos(angles), y + reach * np.sin(angles)], 1), colour)
        elif kind == 1:
            canvas.ellipse(x, y, reach, reach * rng.uniform(0.3, 1.0), colour)
        else:
            canvas.text(str(rng.choice(_WORDS)), x, y, max(reach, 0.06), colour, turn_deg=float(rng.uniform(0, 360)))
    return canvas.image


def _shape(rng: np.random.Generator) -> Mesh:
    """Return a random body about its origin, of largest extent about 1; texture coordinates in 0..1."""
    kind, sizes = int(rng.integers(6)), rng.uniform(0.25, 1.0, 3).tolist()
    if kind == 0:
        return box(sizes)
    if kind == 1:
        return ellipsoid([x / 2 for x in sizes], segments=20)
    if kind == 2:  # a card
        return quad((0, 0, 0), (sizes[0], 0, 0), (0, 0, sizes[1]))
    if kind == 3:  # a vase
        heights = np.linspace(-0.5, 0.5, 9)
        return revolve(np.stack([np.maximum(rng.uniform(0.1, 0.5, 9), 0.12), heights], 1), 20)
    if kind == 4:  # a bent rod
        return tube(np.cumsum(rng.normal(0, 0.25, (6, 3)), axis=0).tolist(), rng.uniform(0.04, 0.15), 10)
    turned = rotation("x", rng.uniform(0, 3)) @ rotation("z", rng.uniform(0, 3))
    return merge([box(sizes), box(rng.uniform(0.2, 0.8, 3).tolist()).moved(turned)])


def _pictured(mesh: Mesh, cell: int) -> Mesh:
    """Return the mesh with the picture number `cell` of the shared image."""
    row, column = divmod(cell, _ROW)
    inside = 0.02 + 0.96 * np.clip(mesh.uv, 0, 1)
    return replace(mesh, uv=(inside + [column, row]) / _ROW)


def _pictures(rng: np.random.Generator) -> np.ndarray:
    rows = [np.concatenate([texture(_CELL, rng) for _ in range(_ROW)], axis=1) for _ in range(_ROW)]
    return np.concatenate(rows)


def _bodies(count: int, rng: np.random.Generator) -> list[Mesh]:
    """Return bodies of random size about their origins."""
    found = []
    for _ in range(count):
        size = np.exp(rng.uniform(np.log(0.08), np.log(0.6)))
        mesh = _shape(rng)
        found.append(_pictured(replace(mesh, vertices=size * mesh.vertices), int(rng.integers(_ROW**2))))
    return found


def _room(rng: np.random.Generator) -> dict[str, Part]:
    """Return floor, back and side walls, somewhat inclined, and bodies that stand about."""
    back, side = rng.uniform(1.0, 5.0), rng.uniform(2.0, 4.5)
    lean = rotation("z", rng.normal(0, 0.15)) @ rotation("x", rng.normal(0, 0.1))
    wall = quad((0, 0, 0), (4 * side, 0, 0), (0, 0, 9)).moved(translation(0, back, 2) @ lean)
    sides = [quad((s * side, 0, 1), (0, -12 * s, 0), (0, 0, 3)) for s in (-1, 1)]
    surfaces = {
        "floor": quad((0, 0, 0), (4 * side, 0, 0), (0, 12, 0)),
        "back": wall,
        "left": sides[0],
        "right": sides[1],
    }
    parts = {}
    for name, mesh in surfaces.items():
        times = rng.uniform(1, 4)
        parts[name] = Part(replace(mesh, uv=mesh.uv * times), Material(texture(_WALL_TEXELS, rng)))
    standing = []
    for mesh in _bodies(int(rng.integers(6, 25)), rng):
        x, y, z = rng.uniform(-1.6, 1.6), rng.uniform(-0.6, back), rng.uniform(0.0, 1.2)
        pose = translation(x, y, z) @ rotation("z", rng.uniform(0, 6)) @ rotation("x", rng.uniform(0, 6))
        standing.append(mesh.moved(pose))
    flat = merge([replace(m, smooth=False) for m in standing])
    return parts | {"clutter": Part(flat, Material(_pictures(rng)))}


def _world(name: str, title: str, move: Callable[[np.random.Generator, Path], Path]) -> World:
    """Return a world whose bodies all move in one way; they are where they were drawn at half of the duration."""

    def build(seed: int, variant: int, duration_s: float) -> WorldScene:
        rng = rng_for(name, seed, variant)
        material = Material(_pictures(rng), None if rng.random() < 0.5 else float(rng.uniform(0.1, 0.4)))
        meshes = _bodies(int(rng.integers(5, 25)), rng)
        paths = {}
        for k in range(len(meshes)):
            place = np.array(_TARGET) + rng.normal(0, 1, 3) * (0.7, 0.5, 0.4)
            turn = (rotation("z", rng.uniform(0, 6)) @ rotation("y", rng.uniform(0, 6)))[:3, :3]
            paths[f"body{k}"] = move(rng, Path(turn, place, np.zeros(3), np.zeros(3)))
        light = street.Light(rng.uniform(-165, -15), rng.uniform(25, 75), rng.uniform(1.5, 3.2), rng.uniform(0.6, 1.3))
        return WorldScene(
            duration_s=duration_s,
            static=_room(rng),
            groups={f"body{k}": (Part(replace(m, smooth=False), material),) for k, m in enumerate(meshes)},
            instances={body: body for body in paths},
            emitters=street.emitters(light, rng),
            poses=lambda t_s: {body: path.at(t_s - duration_s / 2) for body, path in paths.items()},
            exposure=0.95,
            rig=RigSpec(center=(0.0, -2.6, 1.1), target=_TARGET, spacing_m=(0.2, 0.17), toe_in=0.8, fov_x_deg=45.0),
            shadow_sources=np.append(light.to_sun, 0.0)[None],
            depth_range=(0.3, 20.0),
            notes={"bodies": float(len(meshes))},
        )

    return World(name, title, build)


TRAINING_WORLDS: dict[str, World] = {
    world.name: world
    for world in (
        _world("tumble", "Bodies fall and tumble", _falling),
        _world("swarm", "Bodies fly past each other", _flying),
        _world("whirl", "Bodies spin in place", _spinning),
    )
}
