"""The shop fronts of the street: three houses with real window recesses, awnings and name boards."""

from __future__ import annotations

from typing import Any

import numpy as np

from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.parts.street_plan import FRONT_Y, WHITE
from spike4dgs.generators.worlds.primitives.materials import Colour, Material
from spike4dgs.generators.worlds.primitives.meshes import (
    Mesh,
    box,
    merge,
    quad,
)
from spike4dgs.generators.worlds.primitives.textures import Canvas, cloth, fractal, mix, paving, plain


def shops(rng: np.random.Generator) -> dict[str, Part]:
    """Return three house fronts, each a wall with real window recesses, awnings and a name board."""
    walls: tuple[tuple[float, float, Colour, Colour], ...] = (
        (-16.0, -4.9, (0.44, 0.20, 0.13), (0.62, 0.34, 0.24)),
        (-4.9, 3.6, (0.60, 0.55, 0.44), (0.78, 0.72, 0.60)),
        (3.6, 16.0, (0.34, 0.38, 0.42), (0.54, 0.58, 0.62)),
    )
    parts: dict[str, Part] = {}
    names = [["BOOKS", "BIKES"], ["BAKERY", "CAFE"], ["RADIO", "PHOTO"]]
    stripes: list[list[Colour]] = [
        [(0.75, 0.12, 0.10), WHITE],
        [(0.12, 0.35, 0.22), WHITE],
        [(0.15, 0.25, 0.55), WHITE],
    ]
    frames, sills, glass, awnings = [], [], [], []
    for k, (left, right, low, high) in enumerate(walls):
        brick = (6, 14) if k != 1 else (16, 36)
        image = paving((512, 512), rng, brick, low, high, (0.5, 0.48, 0.45), spread=0.22)
        wall = quad(
            ((left + right) / 2, FRONT_Y, 4.0), (right - left, 0, 0), (0, 0, 8.0), ((right - left) / 6.5, 8.0 / 6.5)
        )
        parts[f"wall{k}"] = Part(wall, Material(image))
        bays = np.linspace(left, right, 3)
        for j, x in enumerate((bays[:-1] + bays[1:]) / 2):
            width = (right - left) / 2 - 1.5
            frames.append(_frame(x - 0.45, width, 0.62, 2.35))
            frames.append(_frame(x + width / 2 + 0.22, 0.95, 0.14, 2.35))
            glass.append(_shop_window(x - 0.45, width))
            for w in (-1.0, 0.9):
                frames.append(_frame(x + w, 1.1, 3.6, 5.2))
                sills.append(box((1.4, 0.25, 0.09), (x + w, FRONT_Y - 0.12, 3.5), 0.7))
            awnings.append((x - 0.2, width + 1.5, stripes[(k + j) % 3]))
            board = Canvas(
                plain((48, 384), [(0.05, 0.16, 0.12), (0.30, 0.05, 0.05), (0.05, 0.08, 0.22)][(k + 2 * j) % 3]), 110
            )
            board.text(names[k][j], 384 / 220, 24 / 110, 0.26, (0.85, 0.78, 0.50))
            sign = box((3.4, 0.10, 0.44), (x - 0.2, FRONT_Y - 0.06, 3.08))
            parts[f"board{k}{j}"] = Part(sign, Material(board.image))
        parts[f"plinth{k}"] = Part(
            box((right - left, 0.1, 0.45), ((left + right) / 2, FRONT_Y - 0.04, 0.36), 0.4),
            Material(paving((128, 256), rng, (64, 128), (0.25, 0.24, 0.23), (0.40, 0.38, 0.36), gap=2)),
        )
    for k, (x, width, colours) in enumerate(awnings):
        cover = [
            quad((x, FRONT_Y - 0.5, 2.62), (width, 0, 0), (0, 1.0, 0.5)),
            quad((x, FRONT_Y - 1.0, 2.26), (width, 0, 0), (0, 0, 0.24)),
        ]
        parts[f"awning{k}"] = Part(merge(cover), Material(cloth((64, 256), rng, colours, 16)))
    parts["frames"] = Part(merge(frames), Material((0.70, 0.69, 0.66)))
    parts["sills"] = Part(
        merge(sills), Material(mix(fractal((128, 128), rng, 32), (0.45, 0.43, 0.40), (0.65, 0.63, 0.58)))
    )
    parts["glass"] = Part(merge(glass), Material(_display(rng), 0.08))
    upper = [quad((x, FRONT_Y - 0.01, 4.4), (1.1, 0, 0), (0, 0, 1.6)) for x in _upper_windows(walls)]
    parts["panes"] = Part(merge(upper), Material(_pane(rng), 0.08))
    return parts


def _upper_windows(walls: Any) -> list[float]:
    """Return the middles of the first-floor windows, as `shops` frames them."""
    at = []
    for left, right, *_ in walls:
        bays = np.linspace(left, right, 3)
        at += [x + w for x in (bays[:-1] + bays[1:]) / 2 for w in (-1.0, 0.9)]
    return at


def _frame(x: float, width: float, low: float, high: float) -> Mesh:
    """Return four bars and a crossbar that stand out from the wall."""
    y, bar = FRONT_Y - 0.05, 0.09
    middle = (low + high) / 2
    upright = [box((bar, 0.14, high - low), (x + s * width / 2, y, middle)) for s in (-1, 0, 1)]
    return merge(
        [*upright, *(box((width + bar, 0.14, bar), (x, y, z)) for z in (low, high, low + 0.72 * (high - low)))]
    )


def _shop_window(x: float, width: float) -> Mesh:
    """Return the pane of a shop window and of the door beside it."""
    window = quad((x, FRONT_Y - 0.01, 1.485), (width, 0, 0), (0, 0, 1.73))
    door = quad((x + width / 2 + 0.67, FRONT_Y - 0.012, 1.245), (0.95, 0, 0), (0, 0, 2.21), (0.3, 1.0))
    return merge([window, door])


def _display(rng: np.random.Generator) -> np.ndarray:
    """Return the display of a shop window: shelves of coloured goods in the dark."""
    c = Canvas(mix(np.linspace(0, 1, 160)[:, None] * np.ones((1, 360)), (0.04, 0.04, 0.05), (0.11, 0.10, 0.09)), 100)
    for shelf in (0.5, 0.95, 1.5):
        x = 0.1
        while x < 3.45:
            w, h = rng.uniform(0.07, 0.26), rng.uniform(0.12, 0.36)
            shade = rng.uniform(0.05, 0.75, 3)
            if rng.random() < 0.5:
                c.rectangle(x, shelf - h, x + w, shelf, shade)
            else:
                c.ellipse(x + w / 2, shelf - h / 2, w / 2, h / 2, shade)
            x += w + rng.uniform(0.02, 0.12)
        c.rectangle(0, shelf, 3.6, shelf + 0.04, (0.35, 0.27, 0.18))
    c.polygon([(2.2, 0), (2.7, 0), (1.7, 1.6), (1.2, 1.6)], (0.4, 0.42, 0.45), 0.25)
    return c.image


def _pane(rng: np.random.Generator) -> np.ndarray:
    """Return a first-floor window with curtains."""
    c = Canvas(mix(np.linspace(0, 1, 96)[:, None] * np.ones((1, 66)), (0.12, 0.15, 0.19), (0.03, 0.03, 0.04)), 60)
    folds = cloth((96, 18), rng, [(0.62, 0.58, 0.50), (0.48, 0.44, 0.38)], 3)
    c.image[:, :18] = folds
    c.image[:, -18:] = folds[:, ::-1]
    return c.image
