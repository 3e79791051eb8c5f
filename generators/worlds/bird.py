"""World `bird`: a small bright bird flies over a garden deck, its wings bending with every beat."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from spike4dgs.generators.worlds.base import Deforming, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import rotation, translation
from spike4dgs.generators.worlds.parts import bird_body, garden, street

_PLUMAGES = (
    bird_body.Plumage((0.05, 0.22, 0.60), (0.80, 0.36, 0.06), (0.08, 0.38, 0.62), (0.82, 0.81, 0.76)),
    bird_body.Plumage((0.14, 0.42, 0.08), (0.78, 0.62, 0.05), (0.20, 0.50, 0.16), (0.75, 0.10, 0.08)),
    bird_body.Plumage((0.62, 0.06, 0.05), (0.72, 0.66, 0.58), (0.55, 0.14, 0.10), (0.06, 0.06, 0.07)),
)


@dataclass(frozen=True)
class _Flight:
    """The random choices of a variant; the defaults are those of variant 0."""

    speed_m_s: float = 2.6
    height_m: float = 0.46
    beat: bird_body.Beat = bird_body.Beat(phase=0.7)
    plumage: int = 0
    light: street.Light = street.Light(azimuth_deg=-118.0, elevation_deg=56.0, sun=3.0, sky=0.85)


def _sample(variant: int, rng: np.random.Generator) -> _Flight:
    if variant == 0:
        return _Flight()
    light = street.Light(rng.uniform(-150, -40), rng.uniform(48, 64), rng.uniform(2.9, 3.3), rng.uniform(0.7, 0.95))
    beat = bird_body.Beat(rng.uniform(12, 20), rng.uniform(0.6, 0.8), phase=rng.uniform(0, 2 * np.pi))
    return _Flight(rng.uniform(2.4, 3.4), rng.uniform(0.40, 0.46), beat, int(rng.integers(len(_PLUMAGES))), light)


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. The bird is in the middle of the frame at half of `duration_s`; downstrokes lift its body."""
    rng = rng_for("bird", seed, variant)
    flight = _sample(variant, rng)
    plumage = _PLUMAGES[flight.plumage]

    def pose(t_s: float) -> np.ndarray:
        t = t_s - duration_s / 2
        bob = -0.008 * np.cos(2 * np.pi * flight.beat.hz * t + flight.beat.phase)
        return np.asarray(translation(flight.speed_m_s * t, 0.0, flight.height_m + bob) @ rotation("y", -0.10))

    def carried(points: Callable[[bird_body.Beat, float], np.ndarray]) -> Callable[[float], np.ndarray]:
        def at(t_s: float) -> np.ndarray:
            body, local = pose(t_s), points(flight.beat, t_s - duration_s / 2)
            return np.asarray(local @ body[:3, :3].T + body[:3, 3])

        return at

    return WorldScene(
        duration_s=duration_s,
        static=garden.garden(rng),
        groups={"bird": bird_body.body_parts(plumage, rng)},
        instances={"bird": "bird"},
        emitters=street.emitters(flight.light, rng),
        poses=lambda t_s: {"bird": pose(t_s)},
        exposure=0.95,
        rig=garden.RIG,
        shadow_sources=np.append(flight.light.to_sun, 0.0)[None],
        depth_range=(0.4, 60.0),
        notes={
            "speed_m_s": flight.speed_m_s,
            "length_m": bird_body.LENGTH_M,
            "wing_beats_per_s": flight.beat.hz,
            "wing_span_m": 2 * bird_body.SPAN_M,
        },
        deforming={
            "wing": Deforming(
                bird_body.wings_part(plumage, rng), carried(bird_body.wing_points), bird_body.wing_bodies()
            ),
            "tail": Deforming(bird_body.tail_part(plumage, rng), carried(bird_body.tail_points)),
        },
    )


WORLD = World("bird", "A bird flies over a garden deck", build)
