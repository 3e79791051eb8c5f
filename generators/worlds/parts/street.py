"""The static street: road with markings, pavements, shops, trees, lamps, signs, sky and sun.

The road runs along x. y grows away from the cameras: near pavement, two lanes, far pavement, shop fronts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.meshes import merge, quad
from spike4dgs.generators.worlds.parts.street_furniture import (
    FRONT_Y,
    PAVEMENT_Z,
    ROAD_X,
    ROAD_Y,
    WHITE,
    furniture,
    shops,
    trees,
)
from spike4dgs.generators.worlds.surfaces import Material
from spike4dgs.generators.worlds.textures import Canvas, asphalt, fractal, mix, paving, plain

_TEXELS = 56  # per metre on the ground


@dataclass(frozen=True)
class Light:
    """The sun and the sky: direction towards the sun (azimuth from +x, elevation), irradiance, sky radiance."""

    azimuth_deg: float
    elevation_deg: float
    sun: float
    sky: float

    @property
    def to_sun(self) -> np.ndarray:
        """Unit vector [3] towards the sun."""
        a, e = np.radians([self.azimuth_deg, self.elevation_deg])
        return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


@dataclass(frozen=True)
class Run:
    """A variant of a vehicle that crosses the street: its speed, lane and livery (by number), and the light."""

    speed_m_s: float
    lane_y_m: float
    livery: int
    light: Light


def draw_run(
    rng: np.random.Generator,
    speed_m_s: tuple[float, float],
    lane_y_m: tuple[float, float],
    liveries: int,
    azimuth_deg: tuple[float, float] = (-150, -40),
    elevation_deg: tuple[float, float] = (36, 60),
) -> Run:
    """Return a random run, evenly between bounds, with one of so many liveries."""
    light = Light(rng.uniform(*azimuth_deg), rng.uniform(*elevation_deg), rng.uniform(2.6, 3.4), rng.uniform(0.6, 0.95))
    return Run(rng.uniform(*speed_m_s), rng.uniform(*lane_y_m), int(rng.integers(liveries)), light)


def emitters(light: Light, rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Return Mitsuba emitters: a directional sun, sampled, and a clouded sky, found by BSDF sampling only."""
    height, width = 64, 128
    up = np.sin(np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi)[:, None] * np.ones((1, width))
    rise = np.clip(up, 0, 1).astype(np.float32)
    cloud = np.clip(fractal((height, width), rng, 32, 2) * 2.0 - 0.9, 0, 1) * np.clip(rise * 4, 0, 1)
    blue = mix(np.sqrt(rise), (0.85, 0.90, 1.0), (0.30, 0.50, 0.90))
    sky = blue * (1 - cloud[..., None]) + np.float32([1.15, 1.13, 1.10]) * cloud[..., None]
    sky[up < 0] = (0.17, 0.16, 0.15)
    return {
        "sky": {"type": "envmap", "bitmap": sky, "scale": light.sky, "sampling_weight": 0.0, "z_up": True},
        "sun": {
            "type": "directional",
            "direction": [float(-v) for v in light.to_sun],
            "irradiance": {"type": "rgb", "value": [light.sun, light.sun * 0.95, light.sun * 0.85]},
        },
    }


def street(rng: np.random.Generator) -> dict[str, Part]:
    """Return all static surfaces, name -> part."""
    parts = _ground(rng)
    parts |= shops(rng)
    parts |= trees(rng)
    parts |= furniture(rng)
    return parts


# ---------------------------------------------------------------- ground


def _ground(rng: np.random.Generator) -> dict[str, Part]:
    x0, x1 = ROAD_X
    middle = (x0 + x1) / 2
    pavers = Material(paving((384, 1024), rng, (16, 32)))
    granite = Material(paving((32, 1024), rng, (32, 56), (0.42, 0.42, 0.42), (0.60, 0.60, 0.58), gap=2))
    near_depth, far_depth = 7.0, FRONT_Y - ROAD_Y[1]
    walks = [
        quad((middle, ROAD_Y[0] - 0.25 - near_depth / 2, PAVEMENT_Z), (x1 - x0, 0, 0), (0, near_depth, 0), (2, 1)),
        quad((middle, ROAD_Y[1] + 0.25 + far_depth / 2, PAVEMENT_Z), (x1 - x0, 0, 0), (0, far_depth, 0), (2, 0.5)),
    ]
    kerbs = []
    for y, face in ((ROAD_Y[0] - 0.125, 1), (ROAD_Y[1] + 0.125, -1)):
        kerbs.append(quad((middle, y, PAVEMENT_Z), (x1 - x0, 0, 0), (0, 0.25, 0), (2, 1)))
        kerbs.append(quad((middle, y + face * 0.125, PAVEMENT_Z / 2), (x1 - x0, 0, 0), (0, 0, PAVEMENT_Z), (2, 1)))
    road = quad((middle, sum(ROAD_Y) / 2, 0), (x1 - x0, 0, 0), (0, ROAD_Y[1] - ROAD_Y[0], 0))
    apron = quad((0, 0, -0.05), (160, 0, 0), (0, 160, 0))
    tactile = plain((24, 24), (0.62, 0.48, 0.16))
    yy, xx = np.mgrid[:24, :24] % 8 - 3.5
    tactile[xx**2 + yy**2 < 6] = (0.78, 0.62, 0.25)
    pad = quad((-2.6, ROAD_Y[0] - 0.68, PAVEMENT_Z + 0.005), (2.4, 0, 0), (0, 0.8, 0), (6, 2))
    far_pad = quad((-2.6, ROAD_Y[1] + 0.68, PAVEMENT_Z + 0.005), (2.4, 0, 0), (0, 0.8, 0), (6, 2))
    return {
        "road": Part(road, Material(_road_image(rng))),
        "pavements": Part(merge(walks), pavers),
        "kerbs": Part(merge(kerbs), granite),
        "tactile": Part(merge([pad, far_pad]), Material(tactile)),
        "apron": Part(apron, Material((0.16, 0.16, 0.15))),
    }


def _road_image(rng: np.random.Generator) -> np.ndarray:
    """Return asphalt with all its markings, covers, gutter grates and repairs."""
    x0, x1 = ROAD_X
    depth = ROAD_Y[1] - ROAD_Y[0]
    c = Canvas(asphalt((round(depth * _TEXELS), round((x1 - x0) * _TEXELS)), rng), _TEXELS)

    def at(x: float, y: float) -> tuple[float, float]:
        return x - x0, ROAD_Y[1] - y

    for _ in range(12):  # repaired patches
        x, y = rng.uniform(*ROAD_X), rng.uniform(*ROAD_Y)
        w, h = rng.uniform(0.6, 2.4), rng.uniform(0.4, 1.2)
        corner, shade = at(x, y), rng.uniform(0.05, 0.17)
        c.rectangle(*corner, corner[0] + w, corner[1] + h, (shade, shade, shade * 1.02), 0.55)
    for y in (-1.9, -0.4, 2.2, 3.8):  # darker wheel tracks
        c.line([at(x0, y), at(x1, y)], 0.45, (0.06, 0.06, 0.06), 0.22)
    for _ in range(26):  # tar seams
        p = np.array([rng.uniform(*ROAD_X), rng.uniform(*ROAD_Y)])
        walk = p + np.cumsum(rng.normal(0, (0.22, 0.10), (9, 2)), 0)
        c.line([at(*q) for q in walk], rng.uniform(0.015, 0.04), (0.02, 0.02, 0.02), 0.85)
    _road_marks(c, at)
    for x, y, r in ((1.6, 0.3, 0.36), (-6.8, 3.2, 0.36), (5.2, 3.9, 0.30), (-5.0, -1.6, 0.28)):  # covers
        c.ellipse(*at(x, y), r, r, (0.03, 0.03, 0.03))
        c.ellipse(*at(x, y), r * 0.9, r * 0.9, (0.24, 0.22, 0.20))
        for k in np.linspace(-0.6, 0.6, 5) * r:
            c.line([at(x - 0.6 * r, y + k), at(x + 0.6 * r, y + k)], 0.035, (0.05, 0.05, 0.05))
    for x in (-9.0, 0.4, 8.5):  # gutter grates
        c.rectangle(*at(x, 5.36), x - x0 + 0.7, ROAD_Y[1] - 5.0, (0.03, 0.03, 0.03))
        for k in np.arange(0.04, 0.7, 0.1):
            c.rectangle(*at(x + k, 5.34), x - x0 + k + 0.05, ROAD_Y[1] - 5.02, (0.30, 0.28, 0.26))
    wear = fractal(c.image.shape[:2], rng, 24, 2)[..., None]
    return c.image * (0.80 + 0.30 * wear)


def _road_marks(c: Canvas, at: Any) -> None:
    """Paint a dashed middle line, edge lines, a zebra crossing, an arrow and words."""
    x0, x1 = ROAD_X
    for x in np.arange(x0 + 0.6, x1, 3.2):
        if not -4.6 < x < -0.6:
            c.line([at(x, 1.35), at(x + 1.7, 1.35)], 0.13, WHITE, 0.95)
    for y in (ROAD_Y[0] + 0.35, ROAD_Y[1] - 0.55):
        c.line([at(x0, y), at(x1, y)], 0.12, (0.80, 0.62, 0.15), 0.9)
    for y in np.arange(ROAD_Y[0] + 0.62, ROAD_Y[1] - 0.8, 0.80):
        corner = at(-3.7, y + 0.42)
        c.rectangle(*corner, corner[0] + 2.2, corner[1] + 0.42, WHITE, 0.92)
    for x in (-4.25, -0.95):
        c.line(
            [at(x, ROAD_Y[0] + 0.5), at(x, 1.2)] if x < -2 else [at(x, 1.5), at(x, ROAD_Y[1] - 0.7)], 0.3, WHITE, 0.9
        )
    arrow = [(3.0, 3.0), (4.6, 3.0), (4.6, 2.65), (5.5, 3.12), (4.6, 3.6), (4.6, 3.24), (3.0, 3.24)]
    c.polygon([at(x, y) for x, y in arrow], WHITE, 0.9)
    c.text("BUS", *at(4.6, -0.55), 0.85, (0.80, 0.62, 0.15), opacity=0.9)
    c.text("30", *at(-7.6, -0.6), 0.95, WHITE, opacity=0.9)
