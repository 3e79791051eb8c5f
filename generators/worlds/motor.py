"""World `motor`: a motorcycle races along a street under a gantry of nine cameras, from left to right."""

from __future__ import annotations

from functools import partial

import numpy as np

from spike4dgs.generators.worlds.base import Part, RigSpec, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import (
    Atlas,
    Mesh,
    box,
    ellipsoid,
    loft,
    merge,
    quad,
    revolve,
    rotation,
    skin,
    translation,
    tube,
)
from spike4dgs.generators.worlds.parts import cycles, figure, street
from spike4dgs.generators.worlds.parts.bodywork import Livery
from spike4dgs.generators.worlds.surfaces import Colour, Material
from spike4dgs.generators.worlds.textures import Canvas, plain

LENGTH_M, WHEEL_M = 2.05, 0.315
AXLES_X_M = {"rear": -0.70, "front": 0.71}
_ATLAS = Atlas(1.9, 0.6, 1.2, 200)

_WHITE: Colour = (0.84, 0.83, 0.79)
_DARK: Colour = (0.03, 0.03, 0.035)


_LIVERIES = (
    Livery((0.72, 0.05, 0.04), _WHITE, "46"),
    Livery((0.05, 0.20, 0.62), (0.82, 0.66, 0.08), "93"),
    Livery((0.10, 0.48, 0.14), (0.05, 0.05, 0.06), "5"),
    Livery((0.82, 0.38, 0.03), (0.05, 0.08, 0.25), "88"),
)
_FIRST = street.Run(24.0, 1.2, 0, street.Light(azimuth_deg=-28.0, elevation_deg=33.0, sun=3.3, sky=0.7))


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. The motorcycle is in the middle of the frame at half of `duration_s`; its wheels roll."""
    rng = rng_for("motor", seed, variant)
    run = _FIRST if variant == 0 else street.draw_run(rng, (20, 28), (0.6, 2.0), len(_LIVERIES), (-150, -25), (32, 58))
    livery = _LIVERIES[run.livery]
    suit = figure.Clothes(
        livery.body, livery.second, _DARK, _DARK, skin=_DARK, helmet=livery.second, number=livery.number
    )
    rider = {f"rider_{k}": v for k, v in figure.groups(suit, rng).items()}
    feet = {side: (-0.30, 0.17 * sign, 0.44) for side, sign in figure.SIDES.items()}

    def poses(t_s: float) -> dict[str, np.ndarray]:
        travelled = run.speed_m_s * (t_s - duration_s / 2)
        cycle = translation(travelled, run.lane_y_m, 0.0)
        found = {"body": cycle}
        for name, x in AXLES_X_M.items():
            found[f"{name}_wheel"] = cycle @ cycles.rolling((x, 0.0, WHEEL_M), WHEEL_M, travelled)
        return found | cycles.seated(cycle, (-0.33, 0, 0.93), (0.08, 0, 1.17), (0.40, 0.26, 0.94), feet, -0.05)

    return WorldScene(
        duration_s=duration_s,
        static=street.street(rng),
        groups={"body": body(livery), "wheel": _wheel(livery.second)} | rider,
        instances={"body": "body"} | {f"{k}_wheel": "wheel" for k in AXLES_X_M} | figure.instances("rider_"),
        emitters=street.emitters(run.light, rng),
        poses=poses,
        exposure=1.0,
        rig=RigSpec(
            center=(-0.4, -4.6, 3.8), target=(0.0, 1.25, 0.68), spacing_m=(0.36, 0.30), toe_in=0.75, fov_x_deg=37.0
        ),
        shadow_sources=np.append(run.light.to_sun, 0.0)[None],
        depth_range=(3.0, 32.0),
        notes={
            "speed_m_s": run.speed_m_s,
            "length_m": LENGTH_M,
            "wheel_turns_per_s": run.speed_m_s / (2 * np.pi * WHEEL_M),
        },
    )


# ---------------------------------------------------------------- parts


def body(livery: Livery) -> tuple[Part, ...]:
    """Return all parts but wheels and rider; x forward, origin on the ground between the wheels."""
    shell = merge([_shell(_FAIRING), _shell(_TANK), _shell(_TAIL)])
    seat = ellipsoid((0.24, 0.13, 0.05), (-0.36, 0, 0.83), 18)
    engine = [box((0.34, 0.30, 0.26), (0.02, 0, 0.42)), box((0.24, 0.34, 0.10), (0.0, 0, 0.56))]
    engine += [
        revolve([(0.0, s * 0.17), (0.11, s * 0.17), (0.10, s * 0.20), (0.0, s * 0.20)], 24, "y").at(-0.02, 0, 0.40)
        for s in (-1, 1)
    ]
    fork = [tube([(0.50, s * 0.09, 0.92), (AXLES_X_M["front"], s * 0.09, WHEEL_M)], 0.026) for s in (-1, 1)]
    arms = [tube([(-0.16, s * 0.10, 0.42), (AXLES_X_M["rear"], s * 0.10, WHEEL_M)], 0.032) for s in (-1, 1)]
    pipe = [(0.16, -0.14, 0.30), (-0.20, -0.17, 0.24), (-0.45, -0.19, 0.33), (-0.86, -0.21, 0.47)]
    exhaust = [
        tube(pipe, [0.03, 0.035, 0.055, 0.06], 14),
        tube([(x, -y, z) for x, y, z in pipe], [0.03, 0.035, 0.055, 0.06], 14),
    ]
    bars = [tube([(0.47, s * 0.06, 0.93), (0.40, s * 0.30, 0.91)], 0.018) for s in (-1, 1)]
    mirrors = [ellipsoid((0.03, 0.06, 0.04), (0.60, s * 0.33, 1.02), 12) for s in (-1, 1)]
    guards = [_guard(x, WHEEL_M + 0.03) for x in AXLES_X_M.values()]
    lamp = [ellipsoid((0.06, 0.10, 0.055), (0.83, 0, 0.80), 16)]
    tail_lamp = ellipsoid((0.03, 0.06, 0.025), (-0.84, 0, 0.86), 12)
    screen = ellipsoid((0.16, 0.15, 0.14), (0.60, 0, 1.00), 20)
    plate = Canvas(plain((32, 44), (0.85, 0.85, 0.8)), 200)
    plate.text("20k", 0.11, 0.08, 0.075, (0.02, 0.02, 0.05))
    pegs = [tube([(-0.30, s * 0.10, 0.37), (-0.30, s * 0.24, 0.37)], 0.016, 8) for s in (-1, 1)]
    return (
        Part(_ATLAS.wrap(shell), Material(_paint(livery), 0.12)),
        Part(merge([seat, *bars, *pegs]), Material(_DARK, 0.35)),
        Part(merge(engine), Material((0.22, 0.22, 0.23), 0.25)),
        Part(merge([*fork, *arms]), Material((0.70, 0.62, 0.30), 0.2)),
        Part(merge(exhaust), Material((0.70, 0.69, 0.67), 0.2, metal=True)),
        Part(merge([*guards, *mirrors]), Material(livery.second, 0.15)),
        Part(screen, Material((0.10, 0.11, 0.13), 0.06)),
        Part(merge(lamp), Material((0.86, 0.86, 0.80), 0.08)),
        Part(tail_lamp, Material((0.7, 0.03, 0.03), 0.1)),
        Part(quad((-0.93, 0, 0.66), (0, -0.22, 0), (0.03, 0, 0.16)), Material(plate.image)),
    )


# x, height of the middle, half height, half width
_FAIRING = [(0.14, 0.44, 0.16, 0.17), (0.22, 0.52, 0.27, 0.20), (0.36, 0.60, 0.30, 0.215), (0.52, 0.70, 0.27, 0.21)]
_FAIRING += [(0.66, 0.80, 0.19, 0.19), (0.78, 0.83, 0.12, 0.15), (0.87, 0.82, 0.05, 0.08)]
_TANK = [(-0.20, 0.82, 0.05, 0.08), (-0.12, 0.86, 0.10, 0.12), (0.05, 0.88, 0.13, 0.16), (0.25, 0.88, 0.13, 0.17)]
_TANK += [(0.40, 0.87, 0.10, 0.14), (0.46, 0.86, 0.05, 0.08)]
_TAIL = [(-0.88, 0.90, 0.02, 0.03), (-0.80, 0.885, 0.05, 0.08), (-0.62, 0.84, 0.07, 0.12), (-0.40, 0.76, 0.08, 0.13)]
_TAIL += [(-0.15, 0.72, 0.09, 0.12), (-0.08, 0.72, 0.04, 0.06)]


def _shell(stations: list[tuple[float, float, float, float]]) -> Mesh:
    """Return a smooth skin over superelliptic cross-sections."""
    a = np.linspace(0, 2 * np.pi, 28, endpoint=False)
    return skin(stations, 24, np.stack([np.sign(f) * np.abs(f) ** 0.75 for f in (np.cos(a), np.sin(a))], 1))


def _guard(x: float, radius_m: float) -> Mesh:
    """Return a mudguard over the upper part of a wheel."""
    a = np.radians(np.linspace(25, 150, 14))
    inner = np.stack([x + radius_m * np.cos(a), 0 * a, WHEEL_M + radius_m * np.sin(a)], 1)
    return loft(np.stack([inner + (0, -0.075, -0.01), inner + (0, 0, 0.012), inner + (0, 0.075, -0.01)]), caps=False)


def _wheel(colour: Colour) -> tuple[Part, ...]:
    blades = []
    for k in range(5):
        turn = rotation("y", 2 * np.pi * k / 5)
        blades += [
            box((0.032, 0.05, 0.20), (lean, 0, 0.125)).moved(turn @ rotation("y", lean)) for lean in (-0.035, 0.035)
        ]
    discs = [revolve([(0.07, s * 0.065), (0.15, s * 0.065)], 32, "y") for s in (-1, 1)]
    return (
        Part(cycles.tyre(WHEEL_M, 0.068), cycles.RUBBER),
        Part(merge([cycles.rim(WHEEL_M - 0.085, 0.03, 0.06), *blades]), Material(colour, 0.15)),
        Part(merge(discs), Material((0.45, 0.45, 0.46), 0.25)),
        Part(tube([(0, -0.11, 0), (0, 0.11, 0)], 0.035), Material((0.25, 0.25, 0.25), 0.2)),
        cycles.reflector(WHEEL_M - 0.08, (0.85, 0.45, 0.03)),
    )


def _paint(livery: Livery) -> np.ndarray:
    c = Canvas(plain(_ATLAS.shape, livery.body), _ATLAS.texels_per_m)
    for chart in ("near", "far"):
        at = partial(_ATLAS.at, chart)
        c.polygon(
            at([(0.10, 0.30), (0.60, 0.52), (0.92, 0.76), (0.92, 0.70), (0.62, 0.36), (0.10, 0.22)]), livery.second
        )
        c.polygon(at([(-0.22, 0.86), (0.46, 0.93), (0.46, 0.89), (-0.22, 0.82)]), livery.second)
        c.polygon(at([(-0.9, 0.86), (-0.2, 0.75), (-0.2, 0.71), (-0.9, 0.83)]), livery.second)
        x, y = at([(0.44, 0.66)])[0]
        c.ellipse(x, y, 0.115, 0.115, _WHITE)
        c.text(livery.number, x, y, 0.125, (0.02, 0.02, 0.02))
        x, y = at([(0.13, 0.845)])[0]
        c.text("SPIKE", x, y, 0.055, _WHITE)
    x, y = _ATLAS.at("front", [(0, 0.84)])[0]
    c.ellipse(x, y, 0.10, 0.08, _WHITE)
    c.text(livery.number, x, y, 0.09, (0.02, 0.02, 0.02))
    return c.image


WORLD = World("motor", "A motorcycle races along a street", build)
