"""World `jaywalk`: a runner crosses a street under a gantry of nine cameras, from left to right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import RigSpec, World, WorldScene, rng_for
from spike4dgs.generators.worlds.parts import figure, street

_CLOTHES = (
    figure.Clothes(
        (0.70, 0.10, 0.06), (0.82, 0.80, 0.74), (0.08, 0.13, 0.32), (0.75, 0.74, 0.70), bag=(0.75, 0.52, 0.05)
    ),
    figure.Clothes(
        (0.10, 0.35, 0.55), (0.80, 0.62, 0.10), (0.26, 0.22, 0.17), (0.60, 0.08, 0.06), bag=(0.50, 0.08, 0.10)
    ),
    figure.Clothes(
        (0.75, 0.55, 0.08), (0.08, 0.10, 0.30), (0.06, 0.06, 0.07), (0.70, 0.70, 0.68), bag=(0.08, 0.30, 0.25)
    ),
)
_LENGTH_M = 0.65  # in the direction of motion, between the mean reach of its limbs
_HIP_M, _BOB_M = 0.885, 0.03
_LIFT_M = 0.40  # of the ankle behind the runner
_STANCE = 0.25  # share of a stride in which the foot is on the ground


@dataclass(frozen=True)
class _Run:
    """The random choices of a variant; the defaults are those of variant 0."""

    speed_m_s: float = 5.0
    strides_per_s: float = 1.5
    lane_y_m: float = 0.9
    phase: float = 0.02  # of the stride in the middle of the clip
    clothes: int = 0
    light: street.Light = street.Light(azimuth_deg=-52.0, elevation_deg=38.0, sun=3.1, sky=0.8)


def _sample(variant: int, rng: np.random.Generator) -> _Run:
    if variant == 0:
        return _Run()
    light = street.Light(rng.uniform(-150, -30), rng.uniform(32, 58), rng.uniform(2.6, 3.4), rng.uniform(0.6, 0.95))
    pace, lane = rng.uniform(4.9, 5.6), rng.uniform(0.5, 1.5)
    return _Run(pace, rng.uniform(1.4, 1.6), lane, rng.random(), int(rng.integers(len(_CLOTHES))), light)


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. The runner is in the middle of the frame at half of `duration_s`."""
    rng = rng_for("jaywalk", seed, variant)
    run = _sample(variant, rng)

    def poses(t_s: float) -> dict[str, np.ndarray]:
        return figure.poses(stride(run.speed_m_s, run.strides_per_s, run.phase, run.lane_y_m, t_s - duration_s / 2))

    return WorldScene(
        duration_s=duration_s,
        static=street.street(rng),
        groups=figure.groups(_CLOTHES[run.clothes], rng),
        instances=figure.instances(),
        emitters=street.emitters(run.light, rng),
        poses=poses,
        exposure=0.95,
        rig=RigSpec(
            center=(0.3, -3.9, 3.9), target=(0.05, 1.1, 0.88), spacing_m=(0.32, 0.27), toe_in=0.75, fov_x_deg=36.0
        ),
        shadow_sources=np.append(run.light.to_sun, 0.0)[None],
        depth_range=(2.5, 30.0),
        notes={"speed_m_s": run.speed_m_s, "length_m": _LENGTH_M, "strides_per_s": run.strides_per_s},
    )


def stride(speed_m_s: float, strides_per_s: float, phase: float, lane_y_m: float, t_s: float) -> figure.Joints:
    """Return the joints of a runner who passes x = 0 at t = 0 in the given phase (0..1) of the left foot's stride.

    A foot rests on the ground for a quarter of its stride and swings to its next position in the rest.
    """
    at = phase + strides_per_s * t_s
    x = speed_m_s * t_s
    hip = np.array([x, lane_y_m, _HIP_M + _BOB_M * np.cos(4 * np.pi * (at - _STANCE / 2 - 0.25))])
    neck = hip + figure.TORSO_M * np.array([np.sin(0.2), 0.0, np.cos(0.2)])
    hands, ankles, toes = {}, {}, {}
    for side, sign in figure.SIDES.items():
        share = (at + (0.0 if side == "left" else 0.5)) % 1.0
        ankle, toes[side] = _foot(share, speed_m_s / strides_per_s)
        ankles[side] = np.array([x + ankle[0], lane_y_m + sign * 0.07, ankle[1]])
        swing = np.sin(2 * np.pi * (share - _STANCE / 2 + 0.25))  # the arm is behind while its leg is in front
        ahead, height = 0.13 - 0.30 * swing, 0.27 - 0.10 * swing
        hands[side] = hip + np.array([ahead, sign * (0.23 - 0.06 * abs(swing)), height])
    return figure.Joints(hip, neck, hands, ankles, toes, head_down=0.05)


def _foot(share: float, stride_m: float) -> tuple[tuple[float, float], float]:
    """Return ankle (x relative to the hip, z) and pitch of a foot at a share of its stride; it begins on the ground."""
    reach = stride_m * _STANCE / 2
    if share < _STANCE:
        return (reach * (1 - 2 * share / _STANCE), figure.ANKLE_M), 0.0
    s = (share - _STANCE) / (1 - _STANCE)
    # cubic from the back to the front that leaves and arrives with the ground's speed
    slope = -stride_m * (1 - _STANCE)
    x = (2 * s**3 - 3 * s**2 + 1) * -reach + (s**3 - 2 * s**2 + s) * slope
    x += (3 * s**2 - 2 * s**3) * reach + (s**3 - s**2) * slope
    lift = np.sin(np.pi * s) ** 2 * (1.25 - 0.5 * s)
    return (x, figure.ANKLE_M + _LIFT_M * lift), float(1.1 * np.sin(np.pi * s) * np.cos(np.pi * s / 2))


WORLD = World("jaywalk", "A runner crosses a street", build)
