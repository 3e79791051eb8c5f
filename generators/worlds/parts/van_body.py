"""A parcel van: one skin with painted windows, doors and lettering; bumpers, lamps, ladder, wheels.

Own coordinates: x forward, y to the left, z up, origin on the ground below the middle. Metres.
"""

from __future__ import annotations

from dataclasses import dataclass
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
    tube,
)
from spike4dgs.generators.worlds.parts.bodywork import Section, Wheels, number_plates
from spike4dgs.generators.worlds.surfaces import Colour, Material
from spike4dgs.generators.worlds.textures import Canvas, fractal, plain

LENGTH_M, WIDTH_M, HEIGHT_M = 4.9, 1.95, 2.30
WHEEL_M, RIM_M = 0.34, 0.225
WHEELS = Wheels((-1.45, 1.55), 0.85, WHEEL_M, 0.42)
_SECTION = Section(0.16, 0.05, arc=6, wall=7, lean=0.10, belt=1.15)
_ATLAS = Atlas(LENGTH_M + 0.1, WIDTH_M + 0.1, HEIGHT_M, 104)

GLASS: Colour = (0.035, 0.045, 0.055)
DARK: Colour = (0.03, 0.03, 0.033)

# side outline of the roof line, bonnet and windscreen, from the back to the front
_TOP = np.array(
    [(-2.45, 1.9), (-2.42, 2.1), (-2.3, 2.2), (-1.0, 2.26), (0.6, 2.24), (0.95, 2.16), (1.25, 1.92), (1.62, 1.42)]
    + [(1.75, 1.27), (2.1, 1.13), (2.33, 0.98), (2.43, 0.75), (2.45, 0.55)]
)
_BOTTOM = np.array([(-2.45, 0.42), (-2.38, 0.32), (2.3, 0.28), (2.45, 0.42)])


@dataclass(frozen=True)
class Livery:
    """Colours, linear RGB, and the lettering of the van."""

    body: Colour
    second: Colour
    ink: Colour
    name: str
    slogan: str


def body_parts(livery: Livery, rng: np.random.Generator) -> tuple[Part, ...]:
    """Return all parts that only translate."""
    stations = WHEELS.stations(2.45, 50, [-2.445, -2.43, -2.40, 2.36, 2.40, 2.43, 2.445], 19)
    skin = _ATLAS.wrap(loft(np.stack([_ring(x) for x in stations])))
    floor = box((4.5, 1.35, 0.55), (0, 0, 0.50))
    sills = [box((2.1, 0.04, 0.13), (0.05, s * 0.955, 0.36)) for s in (-1, 1)]
    bumpers = [box((0.16, 1.82, 0.20), (2.40, 0, 0.40)), box((0.12, 1.82, 0.18), (-2.44, 0, 0.42))]
    mirrors = [ellipsoid((0.07, 0.10, 0.15), (1.22, s * 1.10, 1.42), 14) for s in (-1, 1)]
    stalks = [tube([(1.25, s * 0.92, 1.35), (1.22, s * 1.05, 1.40)], 0.03, 8) for s in (-1, 1)]
    lamps = [ellipsoid((0.10, 0.20, 0.10), (2.30, s * 0.68, 0.86), 18) for s in (-1, 1)]
    tails = [box((0.05, 0.14, 0.46), (-2.45, s * 0.86, 1.12)) for s in (-1, 1)]
    rails = [tube([(-2.1, s * 0.72, 2.30), (0.6, s * 0.72, 2.33)], 0.03, 8) for s in (-1, 1)]
    ladder = [tube([(-1.95, y, 2.38), (0.55, y, 2.40)], 0.035, 8) for y in (-0.35, 0.05)]
    ladder += [tube([(x, -0.35, 2.39), (x, 0.05, 2.39)], 0.026, 8) for x in np.linspace(-1.8, 0.4, 9)]
    cross = [tube([(x, -0.74, 2.33), (x, 0.74, 2.33)], 0.026, 8) for x in (-1.7, -0.6, 0.4)]
    tyre = revolve(_tyre(), 40, "y")
    return (
        Part(skin, Material(_paint(livery, rng), 0.14)),
        Part(merge([floor, *sills, *bumpers, *stalks]), Material(DARK)),
        Part(merge(mirrors), Material(livery.second, 0.15)),
        Part(merge(lamps), Material((0.86, 0.86, 0.82), 0.08)),
        Part(merge(tails), Material((0.60, 0.04, 0.03), 0.1)),
        Part(merge([*rails, *cross]), Material((0.10, 0.10, 0.11), 0.2)),
        Part(merge(ladder), Material((0.70, 0.70, 0.68), 0.25)),
        number_plates("20-KHZ", (2.49, 0.42), (-2.51, 0.44)),
        Part(merge([tyre.at(*w) for w in WHEELS.positions()]), Material((0.03, 0.03, 0.032))),
    )


def rim_parts(colour: Colour) -> tuple[Part, ...]:
    """Return a steel wheel about its axle (the y axis), alike from both sides: holes around a hub, one nut painted."""
    dish = [
        revolve([(RIM_M, s * 0.10), (RIM_M - 0.03, s * 0.085), (0.09, s * 0.10), (0.0, s * 0.115)], 40, "y")
        for s in (-1, 1)
    ]
    holes: list[Mesh] = []
    nuts: list[Mesh] = []
    mark: list[Mesh] = []
    for k in range(8):
        turn = rotation("y", 2 * np.pi * k / 8)
        for s in (-1, 1):
            holes.append(ellipsoid((0.028, 0.006, 0.034), (0, s * 0.092, 0.148), 12).moved(turn))
            (mark if k == 0 else nuts).append(ellipsoid((0.014, 0.012, 0.014), (0, s * 0.112, 0.06), 8).moved(turn))
    flags = [box((0.05, 0.012, 0.06), (0, s * 0.10, 0.185)) for s in (-1, 1)]
    return (
        Part(merge(dish), Material(colour, 0.2)),
        Part(merge([*holes, *nuts]), Material(DARK)),
        Part(merge([*mark, *flags]), Material((0.82, 0.12, 0.05))),
    )


def _ring(x: float) -> np.ndarray:
    """Return the cross-section at x: a rounded box whose sides lean in above the belt line, cut by the wheel arches."""
    top, bottom = np.interp(x, _TOP[:, 0], _TOP[:, 1]), np.interp(x, _BOTTOM[:, 0], _BOTTOM[:, 1])
    half = 0.965 * (1 - 0.16 * max(0.0, (x - 1.5) / 0.95) ** 2.5)
    return _SECTION.ring(x, half, WHEELS.cut(x, bottom), top)


def _tyre() -> np.ndarray:
    r0, r1 = RIM_M - 0.005, WHEEL_M
    rows = [(r0, -0.10), (r0 + 0.05, -0.125), (r1 - 0.02, -0.118), (r1, -0.07), (r1, 0.07), (r1 - 0.02, 0.118)]
    return np.array([*rows, (r0 + 0.05, 0.125), (r0, 0.10)])


# ---------------------------------------------------------------- paint


def _paint(livery: Livery, rng: np.random.Generator) -> np.ndarray:
    shade = (0.93 + 0.12 * fractal(_ATLAS.shape, rng, 64, 4))[..., None]
    c = Canvas(plain(_ATLAS.shape, livery.body) * shade, _ATLAS.texels_per_m)
    for chart in ("near", "far"):
        _paint_side(c, chart, livery)
    for chart, is_front in (("front", True), ("back", False)):
        _paint_end(c, chart, livery, is_front)
    _paint_top(c, livery)
    return c.image


def _paint_side(c: Canvas, chart: str, livery: Livery) -> None:
    at = partial(_ATLAS.at, chart)
    c.polygon(at([(-2.5, 0.62), (2.5, 0.86), (2.5, 0.2), (-2.5, 0.2)]), livery.second)
    c.polygon(at([(-2.5, 0.70), (2.5, 0.94), (2.5, 0.88), (-2.5, 0.64)]), livery.ink)
    front = [(0.62, 1.28), (0.62, 1.92), (0.98, 1.92), (1.28, 1.70), (1.58, 1.28)]
    c.polygon(at(front), GLASS)
    c.polygon(at([(0.78, 1.30), (0.92, 1.88), (1.02, 1.86), (0.90, 1.30)]), (0.17, 0.19, 0.21), 0.8)
    c.line(at([*front, front[0]]), 0.03, DARK)
    for x in (0.52, -0.72, -2.28):
        c.line(at([(x, 0.45), (x, 2.05)]), 0.022, DARK)
    c.line(at([(-2.28, 1.12), (-0.72, 1.12)]), 0.018, DARK, 0.6)
    c.polygon(at([(0.36, 1.12), (0.48, 1.12), (0.48, 1.06), (0.36, 1.06)]), DARK)
    c.polygon(at([(-0.66, 1.12), (-0.54, 1.12), (-0.54, 1.06), (-0.66, 1.06)]), DARK)
    x, y = at([(-0.92, 1.55)])[0]
    c.text(livery.name, x, y, 0.34, livery.ink)
    x, y = at([(-0.92, 1.00)])[0]
    c.text(livery.slogan, x, y, 0.15, livery.ink)
    x, y = at([(-0.10, 0.56)])[0]
    c.text("www.s4dgs", x, y, 0.11, livery.body)


def _paint_end(c: Canvas, chart: str, livery: Livery, is_front: bool) -> None:
    at = partial(_ATLAS.at, chart)
    if is_front:
        c.polygon(at([(-0.62, 0.78), (0.62, 0.78), (0.58, 0.56), (-0.58, 0.56)]), DARK)
        for z in (0.62, 0.68, 0.74):
            c.line(at([(-0.6, z), (0.6, z)]), 0.018, (0.5, 0.5, 0.5))
        c.polygon(at([(-0.86, 1.34), (0.86, 1.34), (0.74, 2.05), (-0.74, 2.05)]), GLASS)
        return
    for y in (-0.46, 0.46):
        c.polygon(at([(y - 0.34, 1.42), (y + 0.34, 1.42), (y + 0.30, 1.95), (y - 0.30, 1.95)]), GLASS)
    c.line(at([(0, 0.45), (0, 2.1)]), 0.03, DARK)


def _paint_top(c: Canvas, livery: Livery) -> None:
    at = partial(_ATLAS.at, "top")
    c.polygon(at([(1.02, -0.76), (1.64, -0.86), (1.64, 0.86), (1.02, 0.76)]), GLASS)
    c.polygon(at([(1.2, -0.55), (1.5, -0.60), (1.5, -0.25), (1.2, -0.22)]), (0.15, 0.17, 0.19), 0.8)
    for x in (-2.0, -1.4, -0.8, -0.2, 0.4):
        c.line(at([(x, -0.8), (x, 0.8)]), 0.03, tuple(0.75 * v for v in livery.body), 0.7)
    for y0, y1 in ((-0.34, -0.18), (0.18, 0.34)):
        c.polygon(at([(1.70, y0), (2.42, y0), (2.42, y1), (1.70, y1)]), livery.second)
    x, y = at([(2.02, 0.0)])[0]
    c.ellipse(x, y, 0.14, 0.14, livery.ink)
