"""A world from another package: a pinwheel of four striped blades spins before a wall. Metres, Z up, Y away."""

import numpy as np

from spike4dgs.generators.worlds.base import Part, RigSpec, World, WorldScene, rng_for
from spike4dgs.generators.worlds.meshes import box, quad, rotation, translation
from spike4dgs.generators.worlds.surfaces import Lamp, Material
from spike4dgs.generators.worlds.textures import cloth, paving, wood

BLADE_M, AXLE_Z_M = 0.30, 0.45
COLOURS = ((0.75, 0.22, 0.14), (0.20, 0.50, 0.24), (0.78, 0.58, 0.12), (0.16, 0.32, 0.66))


def build(seed, variant, duration_s):
    """Build the world. Everything random comes from `rng`; variant 0 is the benchmark's and turns 6 times a second."""
    rng = rng_for("pinwheel", seed, variant)
    turns_per_s = 6.0 if variant == 0 else rng.uniform(5.0, 8.0)
    lamp = Lamp((-0.85, -0.75, 1.7) if variant == 0 else (rng.uniform(-1, 1), rng.uniform(-0.9, -0.5), 1.7))

    def poses(t_s):
        return {"wheel": translation(0, 0, AXLE_Z_M) @ rotation("y", 0.3 + 2 * np.pi * turns_per_s * t_s)}

    blades = []
    for k, colour in enumerate(COLOURS):
        blade = box((0.10, 0.012, BLADE_M - 0.02), (0, 0, 0.02 + (BLADE_M - 0.02) / 2))
        stripes = cloth((96, 48), rng, [colour, (0.82, 0.80, 0.74)], 12)
        blades.append(Part(blade.moved(rotation("y", k * np.pi / 2)), Material(stripes, 0.3)))
    tiles = paving((256, 512), rng, (32, 32), (0.40, 0.48, 0.52), (0.60, 0.68, 0.70), (0.75, 0.75, 0.72), 0.12)
    return WorldScene(
        duration_s=duration_s,
        static={
            "floor": Part(quad((0, 0.05, 0), (3.4, 0, 0), (0, 1.5, 0)), Material(wood((320, 640), rng), 0.25)),
            "wall": Part(quad((0, 0.8, 0.75), (3.4, 0, 0), (0, 0, 2.1)), Material(tiles)),
            "post": Part(box((0.02, 0.02, AXLE_Z_M), (0, 0.03, AXLE_Z_M / 2)), Material((0.62, 0.60, 0.56))),
        },
        groups={"wheel": tuple(blades)},  # surfaces that move together, in their own coordinates
        instances={"wheel": "wheel"},  # what is seen of them: name -> group
        emitters=lamp.emitters(),
        poses=poses,
        exposure=1.25,  # white paper in full light has radiance 1
        rig=RigSpec(
            center=(0.0, -1.3, 0.75), target=(0.0, 0.0, 0.42), spacing_m=(0.075, 0.065), toe_in=0.8, fov_x_deg=42.0
        ),
        shadow_sources=lamp.points,
        depth_range=(0.7, 5.0),
        notes={  # a 30 fps camera must smear the object over a quarter of its length
            "speed_m_s": 2 * np.pi * BLADE_M * turns_per_s,
            "length_m": 2 * BLADE_M,
            "turns_per_s": turns_per_s,
        },
    )


WORLDS = {"pinwheel": World("pinwheel", "A pinwheel spins before a wall", build)}
