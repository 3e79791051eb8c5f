"""Rigs that resemble a world's own: another viewpoint, lens and distances, and cameras slightly out of position.

A network that is trained on one rig memorises that rig, so the worlds' own rigs are not in the training data.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import RigSpec, WorldScene
from spike4dgs.generators.worlds.primitives.meshes import rotation

_AZIMUTH_DEG, _ELEVATION_DEG = 25.0, 10.0  # to either side
_LOWEST_DEG, _HIGHEST_DEG = 8.0, 70.0  # elevation seen from the target
_DISTANCE, _SPACING, _FOV = 1.3, 2.0, 1.2  # largest factor; the smallest is its inverse
_TARGET = 0.06  # sd of the target's shift, in distances
_TOE_IN = (0.4, 1.0)
_ROLL_DEG = 6.0
_SHAKEN = 0.5  # share of the rigs whose cameras are out of position, each independently
_SHIFT, _TURN_DEG = 0.15, 1.0  # sd of a camera's shift in spacings, and of its turn about each axis


def jittered_spec(rig: RigSpec, rng: np.random.Generator, amount: float) -> RigSpec:
    """Return a random rig around `rig`; `amount` scales the ranges above: 1 is all of them, 0 none."""
    target, center = np.array(rig.target), np.array(rig.center)
    arm = center - target
    distance = float(np.linalg.norm(arm))
    azimuth, elevation = np.arctan2(arm[1], arm[0]), np.arcsin(arm[2] / distance)

    def factor(most: float) -> float:
        return float(np.exp(amount * rng.uniform(-1, 1) * np.log(most)))

    azimuth += amount * np.radians(rng.uniform(-_AZIMUTH_DEG, _AZIMUTH_DEG))
    elevation += amount * np.radians(rng.uniform(-_ELEVATION_DEG, _ELEVATION_DEG))
    elevation = np.clip(elevation, np.radians(_LOWEST_DEG), np.radians(_HIGHEST_DEG))
    target = target + amount * _TARGET * distance * rng.normal(size=3) * (1, 1, 0.5)
    scale = factor(_DISTANCE)
    flat = np.cos(elevation)
    ray = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    wide, high = (s * scale * factor(_SPACING) for s in rig.spacing_m)
    return RigSpec(
        center=tuple(target + distance * scale * ray),
        target=tuple(target),
        spacing_m=(wide, high),
        toe_in=rig.toe_in + amount * (rng.uniform(*_TOE_IN) - rig.toe_in),
        fov_x_deg=rig.fov_x_deg * factor(_FOV),
    )


def jittered_cameras(
    world: WorldScene, width: int, height: int, rng: np.random.Generator, amount: float = 1.0
) -> tuple[Camera, ...]:
    """Return nine cameras of a random rig around the world's own."""
    spec = jittered_spec(world.rig, rng, amount)
    roll = np.radians(amount * rng.uniform(-_ROLL_DEG, _ROLL_DEG))
    shaken = amount * float(rng.random() < _SHAKEN)
    found = []
    for camera in cameras(replace(world, rig=spec), width, height):
        shift = shaken * _SHIFT * np.mean(spec.spacing_m) * rng.normal(size=3)
        x, y, z = shaken * np.radians(_TURN_DEG) * rng.normal(size=3) + (0, 0, roll)
        turn = (rotation("z", z) @ rotation("y", y) @ rotation("x", x))[:3, :3]
        R = turn @ camera.R
        found.append(replace(camera, R=R, t=-R @ (camera.center + camera.R.T @ shift)))
    return tuple(found)
