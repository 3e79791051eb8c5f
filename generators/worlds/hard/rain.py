"""World `rain`: heavy drops fall over a garden deck, and a ball flies behind them.

Hard for what holds on to the nearest surface: for an instant a drop hides what is behind it, anywhere in the image.
They are half a pixel to 1.5 px wide in `small`, and fall nearly twice their width in a millisecond.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Deforming, Part, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import ellipsoid, merge, rotation, translation
from spike4dgs.generators.worlds.parts import garden, street
from spike4dgs.generators.worlds.parts.rigid_bodies import GRAVITY_M_S2, owners
from spike4dgs.generators.worlds.surfaces import Material
from spike4dgs.generators.worlds.textures import BEACH_BALL, cloth

FALL_M_S = 9.0  # of drops 5 mm wide: Gunn and Kinzer, J. Meteor. 6 (1949)
_LOW, _HIGH = np.array([-0.6, -0.5, 0.0]), np.array([0.6, 0.7, 1.0])  # what drops fill
_DROP_M, _BALL_M = 0.0025, 0.06  # radii


@dataclass(frozen=True)
class _Shower:
    """The random choices of a variant; the defaults are those of variant 0."""

    light: street.Light = street.Light(azimuth_deg=-110.0, elevation_deg=58.0, sun=1.2, sky=1.5)
    drops_m3: float = 150.0  # all large: by Marshall and Palmer's law (1948) 100 mm an hour has 20 wider than 3.5 mm
    wind_m_s: float = 0.8
    ball_m_s: float = 7.0
    spin_rad_s: float = 30.0


def _sample(variant: int, rng: np.random.Generator) -> _Shower:
    if variant == 0:
        return _Shower()
    light = street.Light(rng.uniform(-140, -50), rng.uniform(50, 64), rng.uniform(1.0, 1.4), rng.uniform(1.3, 1.6))
    motion = rng.uniform(-1.5, 1.5), rng.choice([-1.0, 1.0]) * rng.uniform(6, 8), rng.uniform(20, 40)
    return _Shower(light, rng.uniform(120, 180), *motion)


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. The ball is in the middle of the frame at half of `duration_s`; rain falls all the time."""
    rng = rng_for("rain", seed, variant)
    shower = _sample(variant, rng)
    fall = np.array([shower.wind_m_s, 0.0, -FALL_M_S])
    around = np.abs(fall) * duration_s / 2  # what has left, or will come
    low, high = _LOW - around, _HIGH + around
    count = round(shower.drops_m3 * float(np.prod(high - low)))
    centres = rng.uniform(low, high, (count, 3))
    drops = [ellipsoid([_DROP_M * size] * 3, segments=8) for size in rng.uniform(0.7, 1.1, count)]
    local = merge(drops)
    owner, bodies = owners(drops)

    def vertices(t_s: float) -> np.ndarray:
        places = centres + fall * (t_s - duration_s / 2)
        landed = np.minimum(places[:, 2], 0)[:, None] / -FALL_M_S  # seconds ago; drops stay where they land
        return np.asarray(local.vertices + (places - fall * landed)[owner])

    def poses(t_s: float) -> dict[str, np.ndarray]:
        late = t_s - duration_s / 2
        turn = rotation("y", shower.spin_rad_s * late) @ rotation("x", 0.6)
        place = shower.ball_m_s * late, 0.3, 0.4 - GRAVITY_M_S2 / 2 * late**2
        return {"ball": translation(*place) @ turn}

    stripes = Material(cloth((48, 120), rng, BEACH_BALL, 15), 0.12)
    return WorldScene(
        duration_s=duration_s,
        static=garden.garden(rng),
        groups={"ball": (Part(ellipsoid([_BALL_M] * 3, segments=40), stripes),)},
        instances={"ball": "ball"},
        emitters=street.emitters(shower.light, rng),
        poses=poses,
        exposure=1.1,
        rig=garden.RIG,
        shadow_sources=np.append(shower.light.to_sun, 0.0)[None],
        depth_range=(0.3, 60.0),
        notes={"speed_m_s": FALL_M_S, "length_m": 2 * _DROP_M, "bodies": float(count)},
        deforming={"drop": Deforming(Part(local, Material((0.80, 0.84, 0.88))), vertices, bodies)},
    )


WORLD = World("rain", "Heavy drops fall over a deck where a ball flies", build)
