"""A small rally car: body and glasshouse with painted doors, windows and numbers, tyres, lights, spinning rims.

Own coordinates: x forward, y to the left, z up, origin on the ground below the middle. Metres.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.meshes import (
    Atlas,
    Mesh,
    box,
    ellipsoid,
    loft,
    merge,
    revolve,
    rotation,
    translation,
    tube,
)
from spike4dgs.generators.worlds.parts.bodywork import Livery, Section, Wheels, number_plates
from spike4dgs.generators.worlds.surfaces import Colour, Material
from spike4dgs.generators.worlds.textures import Canvas, fractal, mix, plain

LENGTH_M, WIDTH_M, HEIGHT_M = 4.2, 1.76, 1.46
WHEEL_RADIUS_M, RIM_RADIUS_M = 0.33, 0.22
WHEELS = Wheels((-1.29, 1.29), 0.77, WHEEL_RADIUS_M, 0.405)
_BODY = Section(0.17, 0.04, arc=7, wall=5, lean=0.07, belt=0.62, per_m=0.6, crown=0.05)
_CABIN = Section(0.10, 0.01, arc=7, wall=5, lean=0.24, belt=0.62, per_m=0.6, crown=0.03)

GLASS: Colour = (0.03, 0.035, 0.045)
DARK: Colour = (0.025, 0.025, 0.028)
_ATLAS = Atlas(LENGTH_M + 0.1, WIDTH_M + 0.1, HEIGHT_M, 128)
_top = partial(_ATLAS.at, "top")

# side outlines, x from the rear bumper to the nose
_TOP = np.array(
    [(-2.1, 0.50), (-2.09, 0.66), (-2.05, 0.84), (-1.95, 0.93), (-1.6, 0.96), (-0.8, 0.95), (0.3, 0.92), (0.9, 0.89)]
    + [(1.35, 0.83), (1.75, 0.75), (1.97, 0.66), (2.07, 0.55), (2.1, 0.44)]
)
_BOTTOM = np.array([(-2.1, 0.40), (-2.04, 0.28), (-1.9, 0.20), (1.92, 0.17), (2.05, 0.21), (2.1, 0.34)])
_ROOF = np.array(
    [(-1.88, 0.86), (-1.72, 1.02), (-1.45, 1.26), (-1.15, 1.38), (-0.7, 1.44), (-0.1, 1.45), (0.25, 1.40)]
    + [(0.62, 1.17), (1.0, 0.86)]
)


def body_parts(livery: Livery, rng: np.random.Generator) -> tuple[Part, ...]:
    """Return all parts that only translate. The tyres are among them: they look the same at every angle."""
    stations = WHEELS.stations(2.1, 43, [-2.095, -2.08, -2.05, -2.0, 2.0, 2.05, 2.08, 2.095], 21)
    shell = _ATLAS.wrap(loft(np.stack([_body_ring(x) for x in stations])))
    glasshouse = _ATLAS.wrap(loft(np.stack([_cabin_ring(x) for x in np.linspace(-1.87, 0.98, 46)])))
    tyre = revolve(_tyre_profile(), 40, "y")
    floor = box((3.9, 1.15, 0.55), (0, 0, 0.46))
    trims = [box((2.05, 0.03, 0.09), (0, s * 0.855, 0.235)) for s in (-1, 1)]
    trims += [box((0.10, 1.5, 0.10), (2.06, 0, 0.25)), box((0.3, 1.35, 0.03), (-1.72, 0, 1.33))]
    trims += [box((0.05, 0.05, 0.3), (-1.72, s * 0.5, 1.18)) for s in (-1, 1)]
    lamps = [ellipsoid((0.13, 0.17, 0.085), (1.96, s * 0.60, 0.62)) for s in (-1, 1)]
    lamps += [ellipsoid((0.05, 0.07, 0.07), (2.08, s * y, 0.36)) for s in (-1, 1) for y in (0.25, 0.5)]
    tails = [ellipsoid((0.05, 0.15, 0.08), (-2.06, s * 0.66, 0.76)) for s in (-1, 1)]
    mirrors = [ellipsoid((0.09, 0.12, 0.075), (0.52, s * 0.93, 0.99)) for s in (-1, 1)]
    aerial = tube([(-1.2, 0, 1.38), (-1.38, 0, 1.72)], 0.012, 6)
    return (
        Part(shell, Material(_paint_body(livery, rng), 0.12)),
        Part(glasshouse, Material(_paint_cabin(livery), 0.08)),
        Part(merge([tyre.moved(translation(*w)) for w in WHEELS.positions()]), Material(_tyre_image())),
        Part(merge([floor, *trims]), Material(DARK)),
        Part(merge(lamps), Material((0.85, 0.85, 0.82), 0.08)),
        Part(merge(tails), Material((0.6, 0.03, 0.03), 0.08)),
        Part(merge([*mirrors, aerial]), Material(livery.second, 0.12)),
        number_plates("S4-DGS", (2.115, 0.40), (-2.115, 0.60)),
    )


def rim_parts() -> tuple[Part, ...]:
    """Return one rim about its own axle (the y axis): ring, five double spokes, hub; alike from both sides."""
    ring = [(0.205, -0.115), (RIM_RADIUS_M, -0.11), (RIM_RADIUS_M, 0.11), (0.205, 0.115), (0.195, 0.09), (0.195, -0.09)]
    bright: list[Mesh] = [revolve(ring + ring[:1], 40, "y")]
    for k in range(5):
        turn = rotation("y", 2 * np.pi * k / 5)
        for side in (-1, 1):
            for lean in (-0.16, 0.16):
                spoke = box((0.024, 0.03, 0.165), (0, side * 0.088, 0.122))
                bright.append(spoke.moved(turn @ rotation("y", lean)))
    hub = [ellipsoid((0.055, 0.02, 0.055), (0, s * 0.095, 0)) for s in (-1, 1)]
    brake = [revolve([(0.04, s * 0.05), (0.15, s * 0.05)], 32, "y") for s in (-1, 1)]
    behind = [revolve([(0.0, s * 0.03), (0.2, s * 0.03)], 32, "y") for s in (-1, 1)]
    # one painted mark makes a whole turn distinguishable from a fifth of one
    mark = [box((0.05, 0.012, 0.075), (0, s * 0.108, 0.15)) for s in (-1, 1)]
    return (
        Part(merge(bright), Material((0.72, 0.72, 0.74), 0.2)),
        Part(merge(hub), Material((0.10, 0.10, 0.28), 0.1)),
        Part(merge(brake), Material((0.22, 0.22, 0.23))),
        Part(merge(behind), Material(DARK)),
        Part(merge(mark), Material((0.80, 0.10, 0.06))),
    )


# ---------------------------------------------------------------- shape


def _body_ring(x: float) -> np.ndarray:
    """Return the lower body's cross-section at x: a rounded rectangle between the outlines, cut by the wheel arches."""
    top = np.interp(x, _TOP[:, 0], _TOP[:, 1])
    bottom = WHEELS.cut(x, np.interp(x, _BOTTOM[:, 0], _BOTTOM[:, 1]))
    flare = 0.02 * sum(np.exp(-(((x - axle) / 0.5) ** 2)) for axle in WHEELS.axles_x)
    half = WIDTH_M / 2 * (1 - 0.20 * abs(x / 2.1) ** 5) - 0.02 + flare
    return _BODY.ring(x, half, bottom, top)


def _cabin_ring(x: float) -> np.ndarray:
    """Return the cross-section of the glasshouse at x, narrowing towards the roof."""
    roof = np.interp(x, _ROOF[:, 0], _ROOF[:, 1])
    half = 0.80 * (1 - 0.10 * abs((x + 0.45) / 1.45) ** 3)
    return _CABIN.ring(x, half, 0.70, max(roof, 0.72))


def _tyre_profile() -> np.ndarray:
    """Return the half cross-section of a tyre, a flattened ring between rim and tread."""
    r0, r1 = RIM_RADIUS_M - 0.005, WHEEL_RADIUS_M
    profile = [(r0, -0.10), (r0 + 0.05, -0.122), (r1 - 0.02, -0.115), (r1 - 0.004, -0.095), (r1, -0.05), (r1, 0.05)]
    return np.array(profile + [(r1 - 0.004, 0.095), (r1 - 0.02, 0.115), (r0 + 0.05, 0.122), (r0, 0.10)])


# ---------------------------------------------------------------- paint


def _canvas(colour: Colour, rng: np.random.Generator | None = None) -> Canvas:
    image = plain(_ATLAS.shape, colour)
    if rng is not None:
        image *= (0.92 + 0.14 * fractal(_ATLAS.shape, rng, 64, 4))[..., None]
    return Canvas(image, _ATLAS.texels_per_m)


def _paint_body(livery: Livery, rng: np.random.Generator) -> np.ndarray:
    c = _canvas(livery.body, rng)
    white = (0.86, 0.86, 0.83)
    for chart in ("near", "far"):
        at = partial(_ATLAS.at, chart)
        c.polygon(at([(-2.1, 0.50), (-0.75, 0.40), (2.1, 0.40), (2.1, 0.18), (-2.1, 0.18)]), livery.second)
        c.polygon(
            at([(-2.1, 0.55), (-0.75, 0.45), (2.1, 0.45), (2.1, 0.42), (-0.75, 0.42), (-2.1, 0.52)]),
            white,
        )
        for shift, shade in ((0.0, livery.second), (0.32, white)):
            slash = [(-1.02 - shift, 0.90), (-0.80 - shift, 0.90), (-0.98 - shift, 0.46), (-1.2 - shift, 0.48)]
            c.polygon(at(slash), shade)
        for door in ([(-0.72, 0.95), (-0.70, 0.42), (-0.52, 0.25), (0.44, 0.25), (0.52, 0.92)],):
            c.line(at(door), 0.022, DARK)
        c.line(at([(0.86, 0.62), (0.86, 0.28)]), 0.015, DARK, 0.6)
        c.polygon(at([(-0.62, 0.82), (-0.42, 0.82), (-0.42, 0.78), (-0.62, 0.78)]), DARK)
        c.polygon(at([(0.62, 0.72), (0.84, 0.72), (0.80, 0.62), (0.62, 0.62)]), DARK, 0.85)
        x, y = at([(-0.06, 0.62)])[0]
        c.ellipse(x, y, 0.235, 0.235, DARK)
        c.ellipse(x, y, 0.215, 0.215, white)
        c.text(livery.number, x, y, 0.22, (0.02, 0.02, 0.02))
        x, y = at([(1.62, 0.545)])[0]
        c.text("4D", x, y, 0.13, (0.02, 0.02, 0.02))
        x, y = at([(-1.82, 0.66)])[0]
        c.text("20k", x, y, 0.11, white)
        x, y = at([(0.0, 0.325)])[0]
        c.text("S P I K E", x, y, 0.105, white)
    _paint_bonnet(c, livery, white)
    for chart, grille in (("front", True), ("back", False)):
        x, y = _ATLAS.at(chart, [(0, 0.42)])[0]
        c.rectangle(x - 0.62, y - 0.07, x + 0.62, y + 0.07, DARK if grille else livery.second)
    return c.image


def _paint_bonnet(c: Canvas, livery: Livery, white: Colour) -> None:
    """Paint stripes, seams, vents and a number on the bonnet and the boot lid."""
    for y0, y1 in ((-0.30, -0.10), (0.10, 0.30)):
        c.polygon(_top([(0.8, y0), (2.1, y0), (2.1, y1), (0.8, y1)]), livery.second)
        c.polygon(_top([(-2.1, y0), (-1.6, y0), (-1.6, y1), (-2.1, y1)]), livery.second)
    for s in (-1, 1):
        c.polygon(_top([(0.8, s * 0.33), (2.1, s * 0.33), (2.1, s * 0.37), (0.8, s * 0.37)]), white)
        c.line(_top([(1.0, s * 0.74), (1.9, s * 0.62)]), 0.018, DARK)
        for k in range(3):
            x = 1.15 + 0.09 * k
            c.line(_top([(x, s * 0.46), (x + 0.02, s * 0.62)]), 0.03, DARK)
    c.line(_top([(1.93, -0.7), (1.97, 0), (1.93, 0.7)]), 0.02, DARK)
    x, y = _top([(1.5, -0.0)])[0]
    c.ellipse(x, y, 0.2, 0.2, white)
    c.text(livery.number, x, y, 0.19, (0.02, 0.02, 0.02))


def _paint_cabin(livery: Livery) -> np.ndarray:
    c = _canvas(livery.body)
    seat: Colour = (0.10, 0.09, 0.085)
    for chart in ("near", "far"):
        at = partial(_ATLAS.at, chart)
        front = [(-0.50, 0.95), (-0.50, 1.33), (0.10, 1.33), (0.28, 1.27), (0.66, 0.95)]
        rear = [(-0.60, 0.95), (-0.60, 1.33), (-1.02, 1.29), (-1.30, 1.16), (-1.52, 0.95)]
        for window, back in ((front, -0.36), (rear, -1.12)):
            c.polygon(at(window), GLASS)
            c.polygon(at([(back, 0.95), (back - 0.06, 1.2), (back + 0.10, 1.24), (back + 0.2, 0.95)]), seat)
            glint = [(back + 0.38, 0.97), (back + 0.56, 1.27), (back + 0.62, 1.27), (back + 0.44, 0.97)]
            c.polygon(at(glint), (0.16, 0.18, 0.20), 0.8)
        c.line(at([*front, front[0]]), 0.02, DARK)
        c.line(at([*rear, rear[0]]), 0.02, DARK)
    windscreen = [(0.30, -0.56), (0.92, -0.68), (0.92, 0.68), (0.30, 0.56)]
    c.polygon(_top(windscreen), GLASS)
    c.polygon(_top([(0.30, -0.56), (0.38, -0.575), (0.38, 0.575), (0.30, 0.56)]), (0.86, 0.86, 0.83))
    c.polygon(_top([(0.5, -0.2), (0.62, -0.24), (0.62, -0.5), (0.5, -0.48)]), (0.14, 0.12, 0.10), 0.8)
    c.polygon(_top([(-1.24, -0.52), (-1.66, -0.6), (-1.66, 0.6), (-1.24, 0.52)]), GLASS)
    for y0, y1 in ((-0.30, -0.10), (0.10, 0.30)):
        c.polygon(_top([(-1.2, y0), (0.28, y0), (0.28, y1), (-1.2, y1)]), livery.second)
    x, y = _top([(-0.45, 0.0)])[0]
    c.ellipse(x, y, 0.33, 0.33, DARK)
    c.ellipse(x, y, 0.31, 0.31, (0.86, 0.86, 0.83))
    c.text(livery.number, x, y, 0.32, (0.02, 0.02, 0.02))
    return c.image


def _tyre_image() -> np.ndarray:
    """Return the tyre's image: rows run across the profile (sidewall, tread, sidewall) and are the same all around."""
    rows = np.full((64, 4), 0.03, np.float32)
    rows[::7] = 0.012
    rows[8:11] = rows[53:56] = 0.30  # a white ring on each sidewall
    return mix(rows, (0, 0, 0), (1, 1, 1))
