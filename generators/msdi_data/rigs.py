"""Rigs that resemble a world's own, and the rendering of training bursts that they see at a few instants.

The rigs have another viewpoint, lens and distances, and cameras slightly out of position. A network that is trained on
one rig memorises that rig, so the worlds' own rigs are not in the training data.

A rig's background is rendered once, and around each instant only moving objects are, at a few ticks: less exact than
`rendering.render`, and much cheaper, with fewer samples and without the light that moving objects throw far around
them. Training is not misled, because truth and spikes come from the same images. As there, pixels that see only the
shadow of a moving object are the background plus the difference of two renderings with the same random numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.ndimage import maximum_filter

from spike4dgs.benchmark.arrays import Float32, Mask
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import gray
from spike4dgs.benchmark.scene.training_bursts import REACH, Burst
from spike4dgs.generators.profiles import RATE_HZ
from spike4dgs.generators.rendering.mitsuba_scene import mitsuba_scene
from spike4dgs.generators.rendering.render import make_tracer
from spike4dgs.generators.rendering.visibility import GROW_PX, Visibility
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.sensor.calibration import dark_map, gain_map
from spike4dgs.generators.worlds import RigSpec, WorldScene
from spike4dgs.generators.worlds.meshes import rotation

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


KEY_COUNTS = (3, 7, 15)  # images of a burst: 21, 7 or 3 ticks apart
BACKGROUND_SAMPLES = 2  # times those of three images: 64 leave 43 dB of noise in a street, 16 only 36 dB
MOST_PX = 1.0  # largest motion between two of them; the last count serves all faster motion
_FASTEST = 99.0  # percentile of the moving pixels' speeds: shadows at grazing light have no bound


class BurstRenderer(Visibility):
    """Bursts of `cameras` (one resolution) in a world.

    `spp`, a power of two, is the number of samples per pixel of moving objects; where the motion requires more than
    three images, each has fewer samples.
    """

    def __init__(self, world: WorldScene, cameras: Sequence[Camera], *, seed: int, spp: int) -> None:
        scene = mitsuba_scene(world)
        super().__init__(world, cameras, scene)
        self._tracer = make_tracer(scene, cameras, seed)
        self.spp = spp

    @cached_property
    def background(self) -> Float32:
        """Radiance [V, H, W] without moving objects."""
        every = np.arange(int(np.prod(self.shape)))
        return self._radiance(every, BACKGROUND_SAMPLES * self.spp, moving=False).reshape(self.shape)

    def burst(self, tick: int, map_seed: int) -> Burst:
        """Return the burst around the start of `tick` with maps of `map_seed`; `tick` is REACH from the clip's ends."""
        now, reach = tick / RATE_HZ, REACH / RATE_HZ
        moving = self.traced(now - reach) | self.traced(now + reach) | self.traced(now)
        depth, motion = self.depths(now), self._motion_px(now)
        count = next((k for k in KEY_COUNTS if motion <= MOST_PX * (k - 1)), KEY_COUNTS[-1])
        # Between the three times of `traced`, an object may be further away than the region was grown by.
        if (missed := int(np.ceil(motion / 4)) - GROW_PX) > 0:
            moving = maximum_filter(moving, size=(1, 2 * missed + 1, 2 * missed + 1))
        keys = np.repeat(self.background[None], count, axis=0)
        self._trace_moving(keys, moving, now + np.linspace(-reach, reach, count))
        return self._burst(keys, depth, moving, map_seed)

    def at_rest(self, tick: int, map_seed: int) -> Burst:
        """Return a burst of one image in which everything stays as it is at the start of `tick`."""
        depth = self.depths(tick / RATE_HZ)  # sets the time
        every = np.arange(int(np.prod(self.shape)))
        image = self._radiance(every, self.spp, moving=True).reshape(1, *self.shape)
        return self._burst(image, depth, np.zeros(self.shape, bool), map_seed)

    def _burst(self, keys: Float32, depth: Float32, moving: Mask, map_seed: int) -> Burst:
        _, height, width = self.shape
        return Burst(
            keys=keys,
            depth=depth,
            moving=moving,
            w2c=np.stack([c.w2c for c in self.cameras]),
            K=np.stack([c.K for c in self.cameras]),
            gain=np.stack([gain_map(height, width, map_seed, c.id) for c in self.cameras]),
            dark=np.stack([dark_map(height, width, map_seed, c.id) for c in self.cameras]),
        )

    def _trace_moving(self, keys: Float32, moving: np.ndarray, times_s: np.ndarray) -> None:
        """Fill in the pixels `moving` [V, H, W] of the background images `keys` [k, V, H, W] at k times."""
        where = np.flatnonzero(moving)
        spp = max(1, 4 * self.spp // (len(keys) + 1))  # all of them, half, a quarter: powers of two
        first = self._radiance(where, spp, moving=False)
        for key, t_s in zip(keys, times_s.tolist(), strict=True):
            seen = self.object_masks(t_s)[moving]
            traced = self._radiance(where, spp, moving=True)
            key[moving] = np.where(seen, traced, np.maximum(traced + self.background[moving] - first, 0))

    def _motion_px(self, now: float) -> float:
        """Return the motion of the fastest parts in the whole burst."""
        speed = self.speeds(now)
        return float(np.percentile(speed[speed > 0], _FASTEST)) * 2 * REACH / RATE_HZ if (speed > 0).any() else 0.0

    def _radiance(self, pixels: np.ndarray, spp: int, *, moving: bool) -> Float32:
        """Return the gray radiance [K] of flat pixels, with or without the moving objects, at the last time set."""
        rgb = self._tracer.trace(pixels, spp, 0, moving)
        return gray(np.asarray(rgb * np.float32(self.world.exposure)))
