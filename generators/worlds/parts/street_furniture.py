"""What stands along the street: its plan, lamps, trees and benches, and the shops."""

from __future__ import annotations

from typing import Any

import numpy as np

from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.meshes import (
    Mesh,
    box,
    disc,
    ellipsoid,
    merge,
    quad,
    revolve,
    rotation,
    translation,
    tube,
)
from spike4dgs.generators.worlds.surfaces import Colour, Material
from spike4dgs.generators.worlds.textures import Canvas, cloth, fractal, mix, paving, plain

WHITE: Colour = (0.80, 0.79, 0.76)
DARK: Colour = (0.03, 0.03, 0.035)
ROAD_Y = (-2.6, 5.4)  # near and far kerb
ROAD_X = (-16.0, 16.0)
FRONT_Y = 8.6  # the shop fronts
PAVEMENT_Z = 0.14


def trees(rng: np.random.Generator) -> dict[str, Part]:
    """Return three street trees in planters: trunk, branches and some hundred leaf cards each."""
    trunks, leaves, tubs, soil = [], [], [], []
    for x in (-7.3 + rng.uniform(-0.4, 0.4), 1.9 + rng.uniform(-0.4, 0.4), 9.4 + rng.uniform(-0.4, 0.4)):
        y = 6.5
        fork = np.array([x + rng.uniform(-0.1, 0.1), y, 2.3])
        trunks.append(tube([(x, y, 0.1), (x + 0.04, y, 1.2), fork], [0.15, 0.11, 0.085]))
        for a in np.linspace(0, 2 * np.pi, 5)[:-1] + rng.uniform(0, 1):
            tip = fork + [0.7 * np.cos(a), 0.7 * np.sin(a), 0.9]
            trunks.append(tube([fork - [0, 0, 0.1], (fork + tip) / 2 + [0, 0, 0.1], tip], [0.07, 0.05, 0.025], 7))
        middles, turns, sizes, shifts = [], [], [], []
        for _ in range(330):
            d = rng.normal(size=3)
            d *= rng.random() ** 0.35 / np.linalg.norm(d)
            middles.append(fork + [0, 0, 1.15] + d * (1.35, 1.2, 1.1))
            turns.append(rng.normal(size=(3, 3)))
            sizes.append(rng.uniform(0.16, 0.30, 2))
            shifts.append(rng.random(2))
        leaves.append(_cards(*map(np.array, (middles, turns, sizes, shifts))))
        tubs.append(box((1.15, 1.15, 0.5), (x, y, PAVEMENT_Z + 0.25), 0.8))
        soil.append(quad((x, y, PAVEMENT_Z + 0.503), (1.0, 0, 0), (0, 1.0, 0)))
    bark = mix(fractal((64, 64), rng, 16), (0.09, 0.065, 0.04), (0.30, 0.23, 0.16))
    green = mix(fractal((256, 256), rng, 48), (0.06, 0.15, 0.03), (0.34, 0.52, 0.14))
    return {
        "trunks": Part(merge(trunks), Material(bark)),
        "leaves": Part(merge(leaves), Material(green)),
        "tubs": Part(merge(tubs), Material(paving((96, 96), rng, (16, 32), (0.40, 0.24, 0.17), (0.60, 0.40, 0.30)))),
        "soil": Part(merge(soil), Material(mix(fractal((64, 64), rng, 8), (0.04, 0.03, 0.02), (0.16, 0.11, 0.07)))),
    }


def _cards(middles: np.ndarray, turns: np.ndarray, sizes: np.ndarray, shifts: np.ndarray) -> Mesh:
    """Return leaf cards at `middles` [N, 3], turned by the rotation nearest to `turns` [N, 3, 3], of `sizes` [N, 2].

    Each shows another part of the leaves' image, shifted by `shifts` [N, 2].
    """
    card = quad((0, 0, 0), (1, 0, 0), (0, 1, 0), (0.2, 0.2))
    places = np.linalg.qr(turns)[0] @ (np.eye(3) * np.insert(sizes, 2, 1, axis=1)[:, None])
    vertices = card.vertices @ places.swapaxes(1, 2) + middles[:, None]
    faces = card.faces + 4 * np.arange(len(middles))[:, None, None]
    uv = card.uv + shifts[:, None]
    return Mesh(vertices.reshape(-1, 3), faces.reshape(-1, 3), uv.reshape(-1, 2), smooth=False)


def furniture(rng: np.random.Generator) -> dict[str, Part]:
    """Return lamps, signs, a bench, a bin, a hydrant, a letter box, bollards and flower boxes."""
    z = PAVEMENT_Z
    poles, boards = [], {}
    for x in (-4.9, 5.6):
        poles.append(tube([(x, 5.95, z), (x, 5.95, 3.6), (x, 5.75, 4.3), (x, 5.0, 4.45)], 0.06))
        poles.append(revolve([(0.16, 0), (0.16, 0.25), (0.07, 0.45)], 20).at(x, 5.95, z))
    for k, (x, words, edge) in enumerate(
        ((-0.3, "STOP", (0.62, 0.04, 0.04)), (4.0, "30", (0.62, 0.04, 0.04)), (-9.8, "P", (0.05, 0.15, 0.5)))
    ):
        poles.append(tube([(x, 5.92, z), (x, 5.92, 2.75)], 0.035, 8))
        c = Canvas(plain((96, 96), edge if k != 1 else (0.85, 0.85, 0.83)), 96)
        c.ellipse(0.5, 0.5, 0.46, 0.46, (0.85, 0.85, 0.83))
        c.ellipse(0.5, 0.5, 0.40, 0.40, edge)
        if k == 1:
            c.ellipse(0.5, 0.5, 0.33, 0.33, (0.85, 0.85, 0.83))
        c.text(words, 0.5, 0.5, 0.20 if len(words) > 2 else 0.34, (0.03, 0.03, 0.03) if k == 1 else (0.85, 0.85, 0.83))
        turn = rotation("x", np.pi / 2)
        face = quad((0, 0, 0), (0.84, 0, 0), (0, 0.84, 0)) if k == 2 else disc(0.42, segments=32)
        boards[f"sign{k}"] = Part(face.moved(translation(x, 5.87, 2.35) @ turn), Material(c.image))
    slats = [box((1.7, 0.09, 0.04), (-2.0 + 9.4, 7.4 + dy, z + 0.45)) for dy in (-0.2, -0.09, 0.02, 0.13)]
    slats += [box((1.7, 0.04, 0.09), (7.4, 7.62, z + h)) for h in (0.62, 0.75, 0.88)]
    legs = [box((0.06, 0.45, 0.45), (7.4 + dx, 7.4, z + 0.22)) for dx in (-0.7, 0.7)]
    hydrant = revolve([(0.16, 0), (0.16, 0.06), (0.11, 0.08), (0.11, 0.5), (0.14, 0.52), (0.10, 0.66), (0, 0.72)], 20)
    bin_ = revolve([(0.24, 0), (0.27, 0.8), (0.29, 0.82), (0.20, 0.92), (0, 0.95)], 24)
    bollard = revolve([(0.09, 0), (0.075, 0.75), (0.09, 0.78), (0.06, 0.88), (0, 0.9)], 16)
    stripes = mix(((np.arange(96) // 12) % 2)[:, None] * np.ones((1, 8)), (0.08, 0.08, 0.08), (0.80, 0.62, 0.12))
    letter = Canvas(plain((96, 64), (0.70, 0.55, 0.08)), 120)
    letter.rectangle(0.08, 0.15, 0.45, 0.2, (0.03, 0.03, 0.03))
    letter.text("POST", 0.265, 0.38, 0.10, (0.05, 0.05, 0.05))
    bollards = [
        bollard.at(x, y, z) for y in (5.85, -3.1) for x in (-6.2, -1.35, 0.55, 3.2, 6.6) if not (y < 0 and -4 < x < -1)
    ]
    boxes = [box((1.5, 0.5, 0.45), (x, -3.6, z + 0.22), 0.8) for x in (-5.3, 2.4, 7.4)]
    blossoms = []
    for x in (-5.3, 2.4, 7.4):
        for _ in range(70):
            p = (x + rng.uniform(-0.72, 0.72), -3.6 + rng.uniform(-0.22, 0.22), z + rng.uniform(0.46, 0.66))
            r = rng.uniform(0.03, 0.07)
            ball = ellipsoid((r, r, r), p, 6)
            blossoms.append(Mesh(ball.vertices, ball.faces, ball.uv * 0 + rng.random(2), True))
    petals = np.float32([[(0.7, 0.1, 0.2), (0.8, 0.7, 0.1), (0.12, 0.3, 0.06), (0.8, 0.8, 0.8)]] * 4)
    petals = np.repeat(np.repeat(rng.permuted(petals, axis=1), 4, 0), 4, 1)
    return boards | {
        "poles": Part(merge(poles), Material((0.20, 0.22, 0.22), 0.2)),
        "lamp_heads": Part(
            merge([ellipsoid((0.16, 0.36, 0.08), (x, 4.85, 4.42)) for x in (-4.9, 5.6)]),
            Material((0.55, 0.55, 0.55), 0.15),
        ),
        "bench": Part(merge(slats), Material((0.42, 0.25, 0.12))),
        "bench_legs": Part(merge(legs), Material(DARK)),
        "hydrant": Part(hydrant.at(2.9, 5.95, z), Material((0.65, 0.08, 0.05), 0.15)),
        "bin": Part(bin_.at(-1.1, 7.6, z), Material((0.06, 0.22, 0.12), 0.2)),
        "letter_box": Part(box((0.5, 0.4, 0.8), (-3.9, 7.9, z + 0.8)), Material(letter.image)),
        "bollards": Part(merge(bollards), Material(stripes)),
        "flower_boxes": Part(
            merge(boxes), Material(paving((96, 96), rng, (12, 96), (0.30, 0.18, 0.10), (0.48, 0.30, 0.18)))
        ),
        "flowers": Part(merge(blossoms), Material(petals)),
    }


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
