"""The static room around the turntable: desk, wall, posters and the objects on the desk."""

from __future__ import annotations

import numpy as np

from spike4dgs.generators.worlds.base import Part, RigSpec
from spike4dgs.generators.worlds.meshes import (
    box,
    ellipsoid,
    merge,
    quad,
    revolve,
    rotation,
    translation,
    tube,
)
from spike4dgs.generators.worlds.surfaces import Colour, Material
from spike4dgs.generators.worlds.textures import BEACH_BALL, Canvas, cloth, fractal, mix, paving, plain, wood

INK: tuple[Colour, ...] = ((0.55, 0.04, 0.03), (0.03, 0.07, 0.35), (0.03, 0.20, 0.07), (0.03, 0.03, 0.03))
BLOCKS: tuple[Colour, ...] = ((0.75, 0.22, 0.14), (0.20, 0.50, 0.24), (0.78, 0.58, 0.12), (0.16, 0.32, 0.66))


def low_rig(distance_m: float, target_z_m: float) -> RigSpec:
    """Return cameras that look at the middle of the desk from a little above it."""
    return RigSpec(
        center=(0.0, -distance_m, 0.62),
        target=(0.0, 0.0, target_z_m),
        spacing_m=(0.075, 0.065),
        toe_in=0.8,
        fov_x_deg=42.0,
    )


def room(rng: np.random.Generator) -> dict[str, Part]:
    """Return all static surfaces, name -> part."""
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
    parts |= _desk_objects(rng)
    return parts


def _posters(rng: np.random.Generator) -> dict[str, Part]:
    parts = {}
    for k, (x, words) in enumerate(((-0.62, "SPIKE"), (0.0, "4D"), (0.62, "20 kHz"))):
        paper = mix(fractal((150, 210), rng, 40), (0.60, 0.56, 0.44), (0.80, 0.77, 0.66))
        c = Canvas(paper, 500)
        c.rectangle(0.01, 0.01, 0.41, 0.05, INK[k])
        c.text(words, 0.21, 0.14, 0.065, INK[k])
        for j in range(5):
            c.rectangle(0.04, 0.215 + 0.015 * j, 0.04 + rng.uniform(0.15, 0.33), 0.222 + 0.015 * j, (0.08, 0.08, 0.1))
        parts[f"poster{k}"] = Part(quad((x, 0.795, 0.26), (0.44, 0, 0), (0, 0, 0.31)), Material(c.image))
    return parts


def _desk_objects(rng: np.random.Generator) -> dict[str, Part]:
    """Return books, a mug, pencils, a ball, a ruler and sheets of paper, all away from the disc."""
    books: dict[str, Part] = {}
    x = 0.46
    for k, title in enumerate(("GAUSS", "RADON", "HODGE", "NOETHER", "EULER")):
        thick, tall = rng.uniform(0.035, 0.055), rng.uniform(0.18, 0.25)
        spine = Canvas(plain((160, 40), BLOCKS[k % 4]) * (0.8 + 0.3 * fractal((160, 40), rng, 16)[..., None]), 160)
        spine.rectangle(0, 0.06, 0.25, 0.09, (0.80, 0.75, 0.6))
        spine.rectangle(0, 0.91, 0.25, 0.94, (0.80, 0.75, 0.6))
        spine.text(title, 0.125, 0.5, 0.12, (0.85, 0.82, 0.72), turn_deg=90)
        books[f"book{k}"] = Part(box((thick, 0.16, tall), (x + thick / 2, 0.60, tall / 2)), Material(spine.image, 0.2))
        x += thick + 0.003
    mug = revolve([(0.0, 0.006), (0.045, 0.006), (0.047, 0.1), (0.05, 0.1), (0.05, 0.0), (0.0, 0.0)], 40)
    a = np.linspace(-1.3, 1.3, 12)
    handle = tube(np.stack([0.047 + 0.032 * np.cos(a), 0 * a, 0.05 + 0.033 * np.sin(a)], 1), 0.007, 8)
    bands = cloth((32, 64), rng, [(0.80, 0.78, 0.72), (0.12, 0.28, 0.50)], 8)
    pencils, pot = [], revolve([(0.04, 0), (0.042, 0.1), (0.038, 0.1), (0.036, 0.005), (0, 0.005)], 32)
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
    beach = cloth((48, 120), rng, BEACH_BALL, 15)
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
        "sheet": Part(quad((-0.50, -0.36, 0.001), (0.29, 0.06, 0), (-0.04, 0.20, 0)), Material(sheet.image)),
        "ruler": Part(quad((0.50, -0.36, 0.002), (0.30, 0.10, 0), (-0.008, 0.024, 0)), Material(ruler.image, 0.2)),
        "die": Part(
            box((0.05, 0.05, 0.05), (0, 0, 0.025)).moved(translation(0.36, -0.52, 0) @ rotation("z", 0.5)),
            Material(_die()),
        ),
    }


def block_image(letter: str, colour: Colour, rng: np.random.Generator) -> np.ndarray:
    """Return a toy block's face: a coloured frame around a light field with a letter."""
    c = Canvas(plain((96, 96), colour) * (0.85 + 0.25 * fractal((96, 96), rng, 24)[..., None]), 96)
    c.rectangle(0.13, 0.13, 0.87, 0.87, (0.80, 0.76, 0.66))
    c.text(letter, 0.5, 0.5, 0.50, tuple(0.5 * v for v in colour))
    return c.image


def _die() -> np.ndarray:
    c = Canvas(plain((48, 48), (0.80, 0.78, 0.72)), 48)
    for x, y in ((0.25, 0.25), (0.75, 0.25), (0.5, 0.5), (0.25, 0.75), (0.75, 0.75)):
        c.ellipse(x, y, 0.1, 0.1, (0.5, 0.05, 0.05))
    return c.image
