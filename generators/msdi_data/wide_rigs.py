"""Rigs unlike the worlds' own: for networks that match views of any array.

Nine cameras in a grid, on a line, on an arc or scattered; baselines from 2 to 40 % of the distance, long and short
lenses, parallel or turned in. A training takes any three to nine of the nine.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.generators.worlds import WorldScene
from spike4dgs.generators.worlds.meshes import rotation

VIEWS = 9
_BASELINES = (0.02, 0.4)  # the widest of a rig, in distances
_LENSES = (0.35, 1.2)  # factors of the world's field of view: a long lens is a part of a larger image
_DISTANCES = (0.6, 1.4)  # factors of the world's
_AZIMUTH_DEG, _ELEVATION_DEG = 30.0, 12.0  # to either side
_LOWEST_DEG, _HIGHEST_DEG = 8.0, 70.0
_TARGET = 0.12  # sd of the target's shift, in distances
_MOST_SHIFT = 0.4  # of the image's width: by which the target may be out of the middle for want of toe-in
_ROLL_DEG = 4.0  # sd, each camera
_TURN = 0.04  # sd, in fields of view


def layout(rng: np.random.Generator) -> Float64:
    """Return places [9, 2], right and up, of which the two farthest are 1 apart."""
    kind = int(rng.integers(4))
    if kind == 0:
        grid = np.stack(np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0]), axis=-1).reshape(-1, 2)
        places = grid * (1.0, rng.uniform(0.4, 1.0))
    elif kind == 1:
        places = np.stack([np.linspace(-1, 1, VIEWS), np.zeros(VIEWS)], axis=1)
    elif kind == 2:
        angles = np.linspace(0, rng.uniform(0.5, 2) * np.pi, VIEWS)
        places = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    else:
        places = rng.normal(size=(VIEWS, 2))
    places = places + rng.normal(0, 0.06, places.shape)
    widest = np.linalg.norm(places[:, None] - places[None], axis=-1).max()
    return np.asarray((places - places.mean(axis=0)) / widest)


def wide_cameras(
    world: WorldScene, width: int, height: int, rng: np.random.Generator, amount: float = 1.0
) -> tuple[Camera, ...]:
    """Return nine cameras; `amount` scales how far they are from the place of the world's own: 1 is all, 0 none."""
    rig = world.rig
    arm = np.array(rig.center) - np.array(rig.target)
    distance = float(np.linalg.norm(arm))
    azimuth = np.arctan2(arm[1], arm[0]) + amount * np.radians(rng.uniform(-_AZIMUTH_DEG, _AZIMUTH_DEG))
    elevation = np.arcsin(arm[2] / distance) + amount * np.radians(rng.uniform(-_ELEVATION_DEG, _ELEVATION_DEG))
    elevation = np.clip(elevation, np.radians(_LOWEST_DEG), np.radians(_HIGHEST_DEG))
    target = np.array(rig.target) + amount * _TARGET * distance * rng.normal(size=3) * (1, 1, 0.5)
    distance *= float(_between(_DISTANCES, rng)) ** amount
    flat = np.cos(elevation)
    ray = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    center, up = target + distance * ray, np.array([0.0, 0.0, 1.0])
    right = np.cross(-ray, up)
    right /= np.linalg.norm(right)
    fov = np.radians(rig.fov_x_deg * _between(_LENSES, rng))
    focal = 0.5 * width / np.tan(fov / 2)
    baseline = distance * _between(_BASELINES, rng)
    least_toe_in = max(0.0, 1 - _MOST_SHIFT * width * distance / (focal * baseline))
    toe_in = rng.uniform(least_toe_in, 1)
    found = []
    for number, (x, y) in enumerate(layout(rng)):
        shift = baseline * (x * right + y * np.cross(right, -ray) + rng.normal(0, 0.03) * ray)
        aim = target + (1 - toe_in) * shift
        camera = look_at(f"cam_{number:02d}", center + shift, aim, up, focal=focal, width=width, height=height)
        a, b, c = rng.normal(size=3) * (_TURN * fov, _TURN * fov, np.radians(_ROLL_DEG))
        R = (rotation("z", c) @ rotation("y", b) @ rotation("x", a))[:3, :3] @ camera.R
        found.append(replace(camera, R=R, t=-R @ camera.center))
    return tuple(found)


def _between(limits: tuple[float, float], rng: np.random.Generator) -> float:
    """Return a number between the limits, its logarithm uniform."""
    return float(np.exp(rng.uniform(*np.log(limits))))
