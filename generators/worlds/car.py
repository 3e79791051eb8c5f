"""World `car`: a rally car races along a street from left to right under a gantry of nine cameras."""

from __future__ import annotations

import numpy as np

from spike4dgs.generators.worlds.base import RigSpec, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import rotation, translation
from spike4dgs.generators.worlds.parts import street, vehicle
from spike4dgs.generators.worlds.parts.bodywork import Livery

_LIVERIES = (
    Livery((0.82, 0.56, 0.04), (0.03, 0.03, 0.035), "7"),
    Livery((0.80, 0.80, 0.78), (0.55, 0.05, 0.04), "12"),
    Livery((0.35, 0.62, 0.80), (0.80, 0.30, 0.04), "20"),
    Livery((0.50, 0.72, 0.30), (0.04, 0.10, 0.25), "4"),
    Livery((0.85, 0.38, 0.06), (0.04, 0.14, 0.40), "31"),
)
_FIRST = street.Run(32.0, 2.75, 0, street.Light(azimuth_deg=-128.0, elevation_deg=46.0, sun=3.2, sky=0.75))


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. The car is in the middle of the frame at half of `duration_s`; it crosses the view in 0.5 s."""
    rng = rng_for("car", seed, variant)
    run = _FIRST if variant == 0 else street.draw_run(rng, (32, 36), (2.5, 3.2), len(_LIVERIES))
    wheels = vehicle.WHEELS.positions()
    livery = _LIVERIES[run.livery]

    def poses(t_s: float) -> dict[str, np.ndarray]:
        travelled = run.speed_m_s * (t_s - duration_s / 2)
        body = translation(travelled, run.lane_y_m, 0.0)
        roll = rotation("y", travelled / vehicle.WHEEL_RADIUS_M)
        return {"body": body} | {f"rim{k}": body @ translation(*w) @ roll for k, w in enumerate(wheels)}

    return WorldScene(
        duration_s=duration_s,
        static=street.street(rng),
        groups={"body": vehicle.body_parts(livery, rng), "rim": vehicle.rim_parts()},
        instances={"body": "body"} | {f"rim{k}": "rim" for k in range(len(wheels))},
        emitters=street.emitters(run.light, rng),
        poses=poses,
        exposure=0.95,
        rig=RigSpec(
            center=(0.0, -8.2, 7.4), target=(0.0, 2.55, 0.75), spacing_m=(0.6, 0.5), toe_in=0.7, fov_x_deg=48.0
        ),
        shadow_sources=np.append(run.light.to_sun, 0.0)[None],
        depth_range=(5.0, 40.0),
        notes={
            "speed_m_s": run.speed_m_s,
            "length_m": vehicle.LENGTH_M,
            "wheel_turns_per_s": run.speed_m_s / (2 * np.pi * vehicle.WHEEL_RADIUS_M),
        },
    )


WORLD = World("car", "A rally car crosses a street", build)
