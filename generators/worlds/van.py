"""World `van`: a parcel van races along a street under a gantry of nine cameras, from left to right."""

from __future__ import annotations

import numpy as np

from spike4dgs.generators.worlds.base import RigSpec, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import rotation, translation
from spike4dgs.generators.worlds.parts import street, van_body

_LIVERIES = (
    van_body.Livery((0.82, 0.81, 0.77), (0.05, 0.25, 0.45), (0.72, 0.12, 0.05), "FOTON", "5 ms EXPRESS"),
    van_body.Livery((0.78, 0.60, 0.06), (0.06, 0.06, 0.07), (0.55, 0.04, 0.03), "POSTA", "PARCELS FIRST"),
    van_body.Livery((0.14, 0.40, 0.24), (0.80, 0.78, 0.70), (0.82, 0.80, 0.70), "BOTANIK", "PLANTS AND POTS"),
    van_body.Livery((0.45, 0.60, 0.72), (0.60, 0.10, 0.06), (0.04, 0.06, 0.20), "GAUSS", "MOVES ANYTHING"),
)
_FIRST = street.Run(38.0, 2.7, 0, street.Light(azimuth_deg=-62.0, elevation_deg=54.0, sun=2.8, sky=0.95))


def build(seed: int, variant: int, duration_s: float) -> WorldScene:
    """Build the world. The van is in the middle of the frame at half of `duration_s`; its wheels roll."""
    rng = rng_for("van", seed, variant)
    run = _FIRST if variant == 0 else street.draw_run(rng, (37, 42), (2.4, 3.2), len(_LIVERIES))
    livery, wheels = _LIVERIES[run.livery], van_body.WHEELS.positions()

    def poses(t_s: float) -> dict[str, np.ndarray]:
        travelled = run.speed_m_s * (t_s - duration_s / 2)
        body, roll = translation(travelled, run.lane_y_m, 0.0), rotation("y", travelled / van_body.WHEEL_M)
        return {"body": body} | {f"rim{k}": body @ translation(*w) @ roll for k, w in enumerate(wheels)}

    return WorldScene(
        duration_s=duration_s,
        static=street.street(rng),
        groups={"body": van_body.body_parts(livery, rng), "rim": van_body.rim_parts((0.66, 0.66, 0.65))},
        instances={"body": "body"} | {f"rim{k}": "rim" for k in range(len(wheels))},
        emitters=street.emitters(run.light, rng),
        poses=poses,
        exposure=0.92,
        rig=RigSpec(center=(0.5, -8.0, 6.6), target=(0.0, 2.4, 1.0), spacing_m=(0.6, 0.5), toe_in=0.7, fov_x_deg=45.0),
        shadow_sources=np.append(run.light.to_sun, 0.0)[None],
        depth_range=(5.0, 40.0),
        notes={
            "speed_m_s": run.speed_m_s,
            "length_m": van_body.LENGTH_M,
            "wheel_turns_per_s": run.speed_m_s / (2 * np.pi * van_body.WHEEL_M),
        },
    )


WORLD = World("van", "A parcel van races along a street", build)
