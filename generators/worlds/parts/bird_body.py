"""A small bright bird: a rigid body, wings that bend, twist and lag from root to tip without stretching, a tail fan.

Own coordinates: x forward, y to the left, z up, origin in the middle of the body. Metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Part
from spike4dgs.generators.worlds.meshes import Mesh, ellipsoid, merge, skin, surface, tube
from spike4dgs.generators.worlds.surfaces import Colour, Material
from spike4dgs.generators.worlds.textures import Canvas, fractal, mix, plain

LENGTH_M = 0.30
SPAN_M = 0.27  # of one wing, along its bent line
_ALONG, _ACROSS = 33, 9  # points of a wing
_FAN, _BACK = 21, 9  # points of the tail
_ROOT = np.array([0.045, 0.028, 0.030])  # front of the left wing's root


@dataclass(frozen=True)
class Plumage:
    """Colours, linear RGB."""

    back: Colour
    breast: Colour
    wing: Colour
    bar: Colour


@dataclass(frozen=True)
class Beat:
    """Motion of the wings: beats per second, half the stroke and its middle (radians), lag of the tip, twist."""

    hz: float = 12.0
    stroke: float = 0.68
    middle: float = 0.16
    lag: float = 1.0
    twist: float = 0.45
    phase: float = 0.0

    def angles(self, t_s: float, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rise of the wing's line above the horizontal and its chord's pitch, at shares `s` of the span."""
        turn = 2 * np.pi * self.hz * t_s + self.phase - self.lag * s
        rise = self.middle + self.stroke * (0.55 + 0.45 * s) * np.cos(turn) - 0.10 * s
        return rise, self.twist * s * np.sin(turn)

    def tail(self, t_s: float) -> tuple[float, float]:
        """Return half the spread angle of the tail and its pitch (radians): it opens and sinks on the downstroke."""
        down = np.sin(2 * np.pi * self.hz * t_s + self.phase)
        return 0.42 + 0.07 * float(down), -0.05 * float(down)


def body_parts(plumage: Plumage, rng: np.random.Generator) -> tuple[Part, ...]:
    """Return the body with head, beak, eyes and feet."""
    stations = [(-0.105, 0.010, 0.010, 0.013), (-0.085, 0.008, 0.020, 0.023), (-0.045, 0.002, 0.036, 0.036)]
    stations += [(0.0, -0.002, 0.044, 0.041), (0.04, 0.004, 0.041, 0.037), (0.07, 0.018, 0.033, 0.030)]
    stations += [(0.09, 0.030, 0.032, 0.029), (0.112, 0.036, 0.031, 0.028), (0.132, 0.034, 0.022, 0.020)]
    a = np.linspace(0, 2 * np.pi, 28, endpoint=False)
    body = skin([*stations, (0.142, 0.030, 0.008, 0.008)], 40, np.stack([np.sin(a), np.cos(a)], 1))
    beak = tube([(0.132, 0, 0.031), (0.155, 0, 0.028), (0.172, 0, 0.023)], [0.010, 0.006, 0.001], 10)
    eyes = [ellipsoid((0.0075, 0.004, 0.0075), (0.118, s * 0.0255, 0.043), 10) for s in (-1, 1)]
    glints = [ellipsoid((0.002, 0.002, 0.002), (0.121, s * 0.029, 0.046), 6) for s in (-1, 1)]
    feet = [
        tube([(-0.02, s * 0.015, -0.038), (-0.05, s * 0.016, -0.052), (-0.075, s * 0.016, -0.050)], 0.0035, 6)
        for s in (-1, 1)
    ]
    return (
        Part(body, Material(_body_image(plumage, rng))),
        Part(beak, Material((0.75, 0.42, 0.04), 0.2)),
        Part(merge(eyes), Material((0.01, 0.01, 0.012), 0.06)),
        Part(merge(glints), Material((0.9, 0.9, 0.9))),
        Part(merge(feet), Material((0.50, 0.26, 0.06))),
    )


def wings_part(plumage: Plumage, rng: np.random.Generator) -> Part:
    """Return both wings as one mesh; its vertices are those of `wing_points` at t = 0."""
    mesh = merge([surface(np.zeros((_ALONG, _ACROSS, 3)))] * 2)
    return Part(Mesh(wing_points(Beat(), 0.0), mesh.faces, mesh.uv, smooth=True), Material(_feathers(plumage, 11, rng)))


def wing_bodies() -> np.ndarray:
    """Return the body of every face: left wing 0, right wing 1."""
    return np.repeat([0, 1], 2 * (_ALONG - 1) * (_ACROSS - 1))


def wing_points(beat: Beat, t_s: float) -> np.ndarray:
    """Return vertices [N, 3] of both wings in the body's coordinates; the right one mirrors the left one.

    The line along the span is a chain of equal pieces that only turn, so it keeps its length; each chord keeps its own.
    """
    s = np.linspace(0, 1, _ALONG)
    rise, pitch = beat.angles(t_s, s)
    step = SPAN_M / (_ALONG - 1)
    mid = (rise[1:] + rise[:-1]) / 2
    y = np.concatenate([[0], np.cumsum(step * np.cos(mid))])
    z = np.concatenate([[0], np.cumsum(step * np.sin(mid))])
    front = _ROOT + np.stack([0.030 * np.sin(np.pi * np.minimum(s * 1.2, 1)) - 0.055 * s**2.2, y, z], 1)
    chord = _chord(s)
    c = np.linspace(0, 1, _ACROSS)
    lift = 0.10 * np.sin(np.pi * c) * (1 - 0.6 * c)  # camber
    along = np.stack([-np.cos(pitch), np.sin(pitch) * -np.sin(rise), np.sin(pitch) * np.cos(rise)], 1)
    normal = np.stack([np.sin(pitch), -np.cos(pitch) * np.sin(rise), np.cos(pitch) * np.cos(rise)], 1)
    left = front[:, None] + chord[:, None, None] * (c[:, None] * along[:, None] + lift[:, None] * normal[:, None])
    left = left.reshape(-1, 3)
    return np.concatenate([left, left * [1, -1, 1]])


def _chord(s: np.ndarray) -> np.ndarray:
    """Return the depth of the wing at shares of its span, with the tips of the flight feathers."""
    smooth = 0.118 * (1 - 0.10 * s) * np.sqrt(np.clip(1 - np.clip((s - 0.45) / 0.56, 0, 1) ** 2.4, 0.02, 1))
    return np.asarray(smooth * (1 + 0.07 * np.cos(2 * np.pi * 11 * s)))


def tail_part(plumage: Plumage, rng: np.random.Generator) -> Part:
    """Return the tail as one mesh; its vertices are those of `tail_points` at t = 0."""
    mesh = surface(np.zeros((_FAN, _BACK, 3)))
    points = tail_points(Beat(), 0.0)
    return Part(Mesh(points, mesh.faces, mesh.uv, smooth=True), Material(_feathers(plumage, 5, rng)))


def tail_points(beat: Beat, t_s: float) -> np.ndarray:
    """Return the vertices [N, 3] of the tail in the body's coordinates: a fan of feathers that keep their length."""
    spread, pitch = beat.tail(t_s)
    side = np.linspace(-1, 1, _FAN)[:, None]
    back = np.linspace(0, 1, _BACK)
    reach = 0.115 * (1 + 0.06 * np.cos(np.pi * 5 * side)) * back
    turn = spread * side
    away, sink = reach * np.cos(turn), 0.025 * back + 0.010 * side**2 * back
    x = -0.085 - away * np.cos(pitch) - sink * np.sin(pitch)
    y = 0.010 * np.sin(turn) + reach * np.sin(turn)
    z = 0.012 - sink * np.cos(pitch) + away * np.sin(pitch)
    return np.stack([x, y, z], -1).reshape(-1, 3)


def _body_image(plumage: Plumage, rng: np.random.Generator) -> np.ndarray:
    """Return the body's image: u from tail to head (columns), v around it (rows; 0 and 1 are the back)."""
    h, w = 128, 256
    v, u = np.mgrid[:h, :w] / np.array([h, w]).reshape(2, 1, 1)
    belly = np.clip((np.abs(v - 0.5) < 0.21 + 0.05 * np.sin(9 * u)) * 1.0, 0, 1)
    belly *= (u < 0.90) & (u > 0.08)
    image = mix(belly, plumage.back, plumage.breast)
    mask = (np.abs(np.abs(v - 0.5) - 0.27) < 0.045) & (u > 0.74) & (u < 0.97)
    image[mask] = (0.03, 0.03, 0.04)
    cheek = (np.abs(np.abs(v - 0.5) - 0.19) < 0.035) & (u > 0.70) & (u < 0.92)
    image[cheek] = plumage.bar
    scales = 0.80 + 0.30 * (np.sin(2 * np.pi * 26 * u + 2 * np.sin(2 * np.pi * 12 * v)) > 0.2)
    grain = 0.85 + 0.3 * fractal((h, w), rng, 12, 1)
    return np.asarray((image * (scales * grain)[..., None]).astype(np.float32))


def _feathers(plumage: Plumage, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return feathers side by side along u, from the front (row 0) to their tips: coverts, a bar, shafts, dark tips."""
    h, w = 96, 288
    c = Canvas(plain((h, w), plumage.wing), 96)
    c.rectangle(0, 0, 3, 0.30, plumage.back)
    c.rectangle(0, 0.30, 3, 0.40, plumage.bar)
    c.rectangle(0, 0.80, 3, 1.0, (0.04, 0.04, 0.06))
    for k in range(count):
        x = 3 * (k + 0.5) / count
        c.line([(x, 0.38), (x, 0.98)], 0.018, plumage.bar, 0.8)
        c.line([(x + 1.5 / count, 0.40), (x + 1.5 / count, 1.0)], 0.035, (0.02, 0.02, 0.03), 0.9)
        c.ellipse(x, 0.16, 0.09, 0.06, tuple(1.3 * v for v in plumage.back), 0.7)
    return np.asarray(c.image * (0.82 + 0.30 * fractal((h, w), rng, 8, 1))[..., None])
