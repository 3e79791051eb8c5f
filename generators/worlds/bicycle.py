"""World `bicycle`: a racing cyclist crosses a street under a gantry of nine cameras, from left to right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Part, RigSpec, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import box, ellipsoid, merge, revolve, rotation, translation, tube
from spike4dgs.generators.worlds.parts import cycles, figure, street
from spike4dgs.generators.worlds.surfaces import Colour, Material

LENGTH_M, WHEEL_M = 1.68, 0.345
AXLES_X_M = {"rear": -0.495, "front": 0.495}
CRANK_AT = (-0.07, 0.0, 0.29)
CRANK_M = 0.17
_GEAR = 3.1  # turns of a wheel to one of the cranks
_BARS = (0.40, 0.0, 0.97)


def _team(jacket: Colour, stripe: Colour, helmet: Colour, number: str) -> figure.Clothes:
    return figure.Clothes(jacket, stripe, (0.03, 0.03, 0.04), (0.80, 0.79, 0.75), helmet=helmet, number=number)


_TEAMS = (  # rider, colour of the frame
    (_team((0.05, 0.28, 0.62), (0.84, 0.82, 0.20), (0.82, 0.80, 0.76), "8"), (0.78, 0.09, 0.05)),
    (_team((0.75, 0.70, 0.10), (0.05, 0.05, 0.06), (0.70, 0.08, 0.06), "3"), (0.08, 0.32, 0.50)),
    (_team((0.10, 0.45, 0.25), (0.82, 0.80, 0.76), (0.05, 0.05, 0.06), "5"), (0.78, 0.76, 0.72)),
)


@dataclass(frozen=True)
class _Run:
    """The random choices of a variant; the defaults are those of variant 0."""

    speed_m_s: float = 14.0
    lane_y_m: float = 0.7
    crank_rad: float = 0.9  # in the middle of the clip
    team: int = 0
    light: street.Light = street.Light(azimuth_deg=-75.0, elevation_deg=50.0, sun=3.2, sky=0.8)


def _sample(variant: int, rng: np.random.Generator) -> _Run:
    if variant == 0:
        return _Run()
    light = street.Light(rng.uniform(-150, -30), rng.uniform(34, 60), rng.uniform(2.6, 3.4), rng.uniform(0.6, 0.95))
    pace, lane = rng.uniform(13.0, 16.0), rng.uniform(0.3, 1.6)
    return _Run(pace, lane, rng.uniform(0, 2 * np.pi), int(rng.integers(len(_TEAMS))), light)


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. The cyclist is in the middle of the frame at half of `duration_s`; wheels and cranks turn."""
    rng = rng_for("bicycle", seed, variant)
    run = _sample(variant, rng)
    clothes, paint = _TEAMS[run.team]
    rider = {f"rider_{k}": v for k, v in figure.groups(clothes, rng).items()}
    wheels = {f"{name}_wheel": "wheel" for name in AXLES_X_M}

    def poses(t_s: float) -> dict[str, np.ndarray]:
        travelled = run.speed_m_s * (t_s - duration_s / 2)
        cycle = translation(travelled, run.lane_y_m, 0.0)
        turn = run.crank_rad + travelled / WHEEL_M / _GEAR
        found = {"frame": cycle, "crank": cycle @ translation(*CRANK_AT) @ rotation("y", turn)}
        for name, x in AXLES_X_M.items():
            found[f"{name}_wheel"] = cycle @ cycles.rolling((x, 0.0, WHEEL_M), WHEEL_M, travelled)
        feet = {}
        for side, sign in figure.SIDES.items():
            pedal = pedal_at(side, turn)
            found[f"{side}_pedal"] = cycle @ translation(*pedal)
            feet[side] = (pedal[0] - 0.11, pedal[1] + 0.01 * sign, pedal[2] + figure.ANKLE_M + 0.025)
        return found | cycles.seated(cycle, (-0.24, 0, 1.03), (0.17, 0, 1.31), (0.44, 0.19, 0.995), feet, -0.15)

    return WorldScene(
        duration_s=duration_s,
        static=street.street(rng),
        groups={"frame": _frame(paint), "wheel": _wheel(), "crank": _crank(), "pedal": _pedal()} | rider,
        instances={"frame": "frame", "crank": "crank", "left_pedal": "pedal", "right_pedal": "pedal"}
        | wheels
        | figure.instances("rider_"),
        emitters=street.emitters(run.light, rng),
        poses=poses,
        exposure=0.95,
        rig=RigSpec(
            center=(0.2, -3.9, 3.7), target=(0.0, 0.85, 0.80), spacing_m=(0.32, 0.27), toe_in=0.75, fov_x_deg=38.0
        ),
        shadow_sources=np.append(run.light.to_sun, 0.0)[None],
        depth_range=(2.5, 30.0),
        notes={
            "speed_m_s": run.speed_m_s,
            "length_m": LENGTH_M,
            "wheel_turns_per_s": run.speed_m_s / (2 * np.pi * WHEEL_M),
            "crank_turns_per_s": run.speed_m_s / (2 * np.pi * WHEEL_M * _GEAR),
        },
    )


def pedal_at(side: str, turn_rad: float) -> tuple[float, float, float]:
    """Return the middle of a pedal in the bicycle's coordinates; the left one is up at turn zero."""
    sign = figure.SIDES[side]
    x, _, z = CRANK_AT
    return x + sign * CRANK_M * np.sin(turn_rad), 0.11 * sign, z + sign * CRANK_M * np.cos(turn_rad)


# ---------------------------------------------------------------- parts


def _frame(paint: Colour) -> tuple[Part, ...]:
    """Return frame, forks, bars, saddle, brakes and a bottle."""
    rear, front = ((x, 0.0, WHEEL_M) for x in AXLES_X_M.values())
    head_low, head_high = (0.36, 0.0, 0.70), (0.315, 0.0, 0.87)
    seat_top = (-0.215, 0.0, 0.80)
    tubes = [
        tube([CRANK_AT, seat_top], 0.020),
        tube([CRANK_AT, head_low], 0.026),
        tube([seat_top, head_high], 0.020),
        tube([head_low, head_high], 0.026),
    ]
    for y in (-0.055, 0.055):
        tubes += [tube([(CRANK_AT[0], y * 0.6, CRANK_AT[2]), (rear[0], y, rear[2])], 0.012)]
        tubes += [tube([(seat_top[0], y * 0.4, seat_top[2]), (rear[0], y, rear[2])], 0.011)]
    fork = [tube([(0.365, y, 0.69), (0.42, y, 0.55), (front[0], y, front[2])], 0.014) for y in (-0.05, 0.05)]
    drop = [(0.40, 0.0, 0.96), (0.40, 0.19, 0.96), (0.47, 0.205, 0.95), (0.485, 0.205, 0.88), (0.43, 0.205, 0.84)]
    bars = [tube([(x, s * y, z) for x, y, z in drop], 0.014) for s in (-1, 1)]
    dark = [tube([head_high, (0.30, 0, 0.93), _BARS], 0.016), tube([seat_top, (-0.24, 0, 0.95)], 0.014), *bars]
    dark += [tube([(0.47, s * 0.205, 0.95), (0.50, s * 0.205, 1.00)], 0.014, 8) for s in (-1, 1)]
    saddle = [
        ellipsoid((0.13, 0.055, 0.024), (-0.24, 0, 0.97), 16),
        ellipsoid((0.09, 0.025, 0.02), (-0.13, 0, 0.968), 12),
    ]
    bottle = tube([(0.045, 0, 0.42), (0.145, 0, 0.565)], 0.037, 14)
    chain = [
        tube([(CRANK_AT[0], -0.05, CRANK_AT[2] + s * 0.09), (rear[0], -0.05, WHEEL_M + s * 0.04)], 0.008, 6)
        for s in (-1, 1)
    ]
    return (
        Part(merge(tubes), Material(paint, 0.12)),
        Part(merge(fork), Material((0.80, 0.79, 0.76), 0.12)),
        Part(merge([*dark, *saddle]), Material((0.03, 0.03, 0.035), 0.3)),
        Part(bottle, Material((0.80, 0.72, 0.15), 0.2)),
        Part(merge(chain), Material((0.16, 0.15, 0.14))),
    )


def _wheel() -> tuple[Part, ...]:
    bright = [cycles.spokes(WHEEL_M - 0.05, 0.02, 18, 0.0035, 0.035), tube([(0, -0.06, 0), (0, 0.06, 0)], 0.022)]
    return (
        Part(cycles.tyre(WHEEL_M, 0.016), cycles.RUBBER),
        Part(cycles.rim(WHEEL_M - 0.026, 0.045, 0.012), Material((0.08, 0.08, 0.09), 0.2)),
        Part(merge(bright), Material((0.70, 0.70, 0.70), 0.2)),
        cycles.reflector(WHEEL_M, (0.85, 0.45, 0.03)),
    )


def _crank() -> tuple[Part, ...]:
    """Return both crank arms and the chain ring, about the bottom bracket; the left arm points up."""
    arms = [box((0.028, 0.016, CRANK_M), (0, s * 0.075, s * CRANK_M / 2)) for s in (-1, 1)]
    ring = revolve([(0.075, -0.048), (0.095, -0.048), (0.095, -0.053), (0.075, -0.053), (0.075, -0.048)], 32, "y")
    legs = [box((0.016, 0.006, 0.15), (0, -0.05, 0)).moved(rotation("y", k * np.pi / 3)) for k in range(3)]
    axle = tube([(0, -0.085, 0), (0, 0.085, 0)], 0.02)
    return (
        Part(merge(arms), Material((0.75, 0.75, 0.74), 0.2)),
        Part(merge([ring, axle, *legs]), Material((0.55, 0.55, 0.55), 0.2)),
    )


def _pedal() -> tuple[Part, ...]:
    return (Part(box((0.09, 0.07, 0.022)), Material((0.05, 0.05, 0.05))),)


WORLD = World("bicycle", "A racing cyclist crosses a street", build)
