"""What real cameras and lamps have and ideal ones lack: each an option of `make-dataset`, each off at no cost.

Two cameras have names. `ideal` is a pinhole in steady light with a calibration of the same minute. `realistic` has a
lens, a blur and a drift with these sources:

- lens, spread, principal point: the two cameras of the EuRoC MAV dataset's VI-sensor (Burri et al. 2016, sensor.yaml):
  k1 -0.2834 and -0.2837, k2 0.0740 and 0.0745, 752 x 480 px, principal points 8.8 and -4.0 px left and 8.4 and 15.2 px
  below the middle: 10 px RMS or 0.013 of the width. The tangential coefficients, below 0.0002, are left out.
- blur: a Gaussian of 0.5 px has the spread of a circle of confusion of 2 px (a disk of diameter D: D / 4), twice the
  pixel to which machine vision counts depth of field. With the pixel's box, contrast falls to a half at 0.32 cycles per
  pixel; with the box alone it does at 0.60.
- drift: the sensor is 8 K warmer in the clip than when it was calibrated, which doubles its dark rate (`DOUBLING_K`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.lens import NAMES, Distortion, make_distortion
from spike4dgs.benchmark.spikes.sensor_model import MOST_DEAD_TICKS

# Literature has doublings every 5 to 8 K near room temperature (A. Theuwissen, harvestimaging.com, September 2009).
# Silicon's band gap gives 4.5 K where dark current comes by diffusion and 9.0 K where it is generated in depletion.
DOUBLING_K = 8.0
MOST_PSF_PX = 0.8  # moving objects are traced 3 px around: three standard deviations and half a pixel
_MOST_NOISE = 0.2  # thresholds


@dataclass(frozen=True)
class Physics:
    """Deviations of the cameras, the light and the pace from ideal ones; each is off by default.

    Attributes:
        lens: distortion of every camera, or their mean.
        lens_spread: largest share by which a camera's coefficients differ from it.
        principal_point: standard deviation of a camera's principal point from the middle, each way, in image widths.
        pose_noise_deg, pose_noise_m: standard deviations, each axis, of the poses that methods are given from the true
            ones. The held-out camera of the default split keeps its true pose: it is the question, not a measurement.
        psf_px: standard deviation of the optics' blur, a Gaussian, before the pixel's box.
        flicker: (highest - lowest) / (highest + lowest) light; 1 is off in between.
        flicker_hz: frequency of the flicker, twice that of the mains.
        flicker_duty: share of a period in which an LED is on; 0 is a sine.
        warming_k: temperature of the sensors in the clip above that at calibration.
        reset_noise, read_noise, dead_ticks, clock_ripple: see `sensor.model.Sensor`.
        light: share of the light that reaches the sensors, in the clip and at calibration, as of a stopped-down lens.
        lost_ticks: share of a clip's ticks that each camera loses; the scene lists them as gaps.
        speed: of all motion, in units of the world's own.
        array_motion: speed of the whole array along its path, m/s; see `rig.ArrayPath`.
        array_rotation: angular speed of the whole array, degrees/s.
        noisy_others: frame and event cameras have noise, see `other_sensors`; spikes and truth stay the same.
    """

    lens: Distortion = ()
    lens_spread: float = 0.0
    principal_point: float = 0.0
    pose_noise_deg: float = 0.0
    pose_noise_m: float = 0.0
    psf_px: float = 0.0
    flicker: float = 0.0
    flicker_hz: float = 100.0
    flicker_duty: float = 0.0
    warming_k: float = 0.0
    reset_noise: float = 0.0
    read_noise: float = 0.0
    dead_ticks: float = 0.0
    clock_ripple: float = 0.0
    light: float = 1.0
    lost_ticks: float = 0.0
    speed: float = 1.0
    array_motion: float = 0.0
    array_rotation: float = 0.0
    noisy_others: bool = False

    @property
    def settings(self) -> dict[str, Any]:
        """The values that are not the default ones, for `source.physics` of scene.json."""
        changed = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) != f.default}
        return {name: list(v) if isinstance(v, tuple) else v for name, v in changed.items()}

    @property
    def suffix(self) -> str:
        """The end of a scene's id: what is on, such as `-lens-psf`, or the name of the camera."""
        for name, camera in CAMERAS.items():
            if self == camera:
                return "" if name == IDEAL else f"-{name}"
        on = [(name, word) for name, word in _WORDS.items() if name in self.settings]
        sizes = {"light": _fraction(self.light), "speed": _fraction(self.speed)}
        return "".join(f"-{word}{sizes.get(name, '')}" for name, word in on)

    @property
    def dark_factor(self) -> float:
        """Dark rate in the clip, in units of that at calibration."""
        return float(2 ** (self.warming_k / DOUBLING_K))

    @property
    def moves_poses(self) -> bool:
        """True where methods are given other poses than the true ones."""
        return self.pose_noise_deg > 0 or self.pose_noise_m > 0

    @property
    def moves_array(self) -> bool:
        """True where the array moves during the clip."""
        return self.array_motion > 0 or self.array_rotation > 0


_WORDS = {
    "lens": "lens",
    "principal_point": "centers",
    "pose_noise_deg": "turned",
    "pose_noise_m": "moved",
    "psf_px": "psf",
    "flicker": "flicker",
    "warming_k": "warm",
    "reset_noise": "reset",
    "read_noise": "read",
    "dead_ticks": "dead",
    "clock_ripple": "ripple",
    "light": "light",
    "lost_ticks": "lost",
    "speed": "speed",
    "array_motion": "arraymotion",
    "array_rotation": "arrayrotation",
    "noisy_others": "others",
}


def _fraction(share: float) -> str:
    """Return a share as a word: 1of4, or 2."""
    found = Fraction(share).limit_denominator(1024)
    return f"{found.numerator}of{found.denominator}" if found.denominator > 1 else str(found.numerator)


IDEAL, REALISTIC = "ideal", "realistic"
CAMERAS = {
    IDEAL: Physics(),
    REALISTIC: Physics(
        lens=make_distortion((-0.2835, 0.0742)), lens_spread=0.003, principal_point=0.013, psf_px=0.5, warming_k=8.0
    ),
}


@dataclass(frozen=True)
class PhysicsOptions:
    """Deviations from ideal cameras and lamps. Options that are left out have the values of --camera.

    Args:
        camera: ideal: pinholes, steady light, a calibration of the same minute. realistic: a lens, principal points,
            blur and a warmer sensor, as published for real cameras; the scene's id ends in -realistic.
        lens: Distortion of every camera's lens: OpenCV's k1, k2, p1, p2, k3, or the first few, such as -0.15 0.03; 0 is
            none. Streams, other recordings and ground truth all show it. The scene's id ends in -lens; most of the
            options below add a word too.
        lens_spread: Largest relative difference of a camera's coefficients from --lens, such as 0.3, drawn by the seed.
        principal_point: Standard deviation of the principal points from the middle, in image widths, such as 0.013.
        pose_noise_deg: Standard deviation, in degrees about each axis, of the errors of the given poses.
        pose_noise_m: Standard deviation, in metres along each axis, of the errors of the given camera centres.
        psf_px: Standard deviation of the optics' Gaussian blur in px, at most 0.8; in streams and in ground truth.
        flicker: Depth of the light's flicker, (highest - lowest) / (highest + lowest), such as 0.08.
        flicker_hz: Frequency of the flicker; 100 for mains of 50 Hz.
        flicker_duty: Share of a period in which a dimmed LED is on; 0 is a sine.
        warming_k: Kelvin by which the sensors are warmer in the clip than at calibration; 8 doubles the dark rate.
        reset_noise: Standard deviation of the charge that a reset removes, in thresholds, such as 0.0009 (kTC).
        read_noise: Standard deviation of the comparator's error in a tick, in thresholds, such as 0.006.
        dead_ticks: Ticks for which a pixel collects no light after its charge is full; 1 in a published calibration.
        clock_ripple: How much the charge of a spike varies with its place in the tick, in thresholds, such as 0.008; it
            makes pixels lock to whole intervals.
        light: Share of the light that reaches the sensors, in the clip and at calibration, such as 0.25; above 1,
            highlights saturate. The scene's id includes it: -light1of4.
        lost_ticks: Share of the clip's ticks that each camera loses, such as 0.05. The scene lists them as gaps, so
            commands that read it need --allow-gaps.
        speed: Speed of all motion, relative to the world's own, such as 2. The scene's id includes it: -speed2.
        array_motion: Speed of the whole array along an arc in metres per second, as on a vehicle or in a hand. The
            scene's cameras keep their poses in the array, so everything that they see moves relative to them.
        array_rotation: Angular speed in degrees per second at which the whole array turns about its middle camera.
        noisy_others: Give the frame cameras shot and read noise, and the event cameras unequal thresholds, shot events
            and a refractory period, as published; spikes and truth do not change.
    """

    camera: str = IDEAL
    lens: tuple[float, ...] = ()
    lens_spread: float | None = None
    principal_point: float | None = None
    pose_noise_deg: float | None = None
    pose_noise_m: float | None = None
    psf_px: float | None = None
    flicker: float | None = None
    flicker_hz: float | None = None
    flicker_duty: float | None = None
    warming_k: float | None = None
    reset_noise: float | None = None
    read_noise: float | None = None
    dead_ticks: float | None = None
    clock_ripple: float | None = None
    light: float | None = None
    lost_ticks: float | None = None
    speed: float | None = None
    array_motion: float | None = None
    array_rotation: float | None = None
    noisy_others: bool = False

    def physics(self) -> Physics:
        """Return the physics. Raises UserError for an unknown camera and for numbers that no camera has."""
        if self.camera not in CAMERAS:
            raise problem("--camera", f"one of {', '.join(CAMERAS)}", repr(self.camera), "correct the name")
        if len(self.lens) > len(NAMES) or not all(map(math.isfinite, self.lens)):
            raise problem("--lens", f"at most {len(NAMES)} numbers: {', '.join(NAMES)}", str(self.lens), "correct it")
        given = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("camera", "lens")}
        changed: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        if self.lens:
            changed["lens"] = make_distortion(self.lens)
        found = replace(CAMERAS[self.camera], **changed)
        if not found.flicker and (self.flicker_hz is not None or self.flicker_duty is not None):
            raise problem("--flicker-hz and --flicker-duty", "the depth, --flicker", "none", "give it, or neither")
        if found.lens_spread and not found.lens:
            if self.lens_spread:
                raise problem("--lens-spread", "the mean lens, --lens", "none", "give both, or leave both out")
            found = replace(found, lens_spread=0.0)
        _check(found)
        return found


NO_OPTIONS = PhysicsOptions()

_RANGES: dict[str, tuple[str, float, float]] = {  # what it is, from, to
    "lens_spread": ("a share from 0 to below 1", 0, 0.999),
    "principal_point": ("a share of the image's width from 0 to 0.2", 0, 0.2),
    "pose_noise_deg": ("degrees from 0 to 5", 0, 5),
    "pose_noise_m": ("metres from 0 to 1", 0, 1),
    "psf_px": (f"px from 0 to {MOST_PSF_PX}", 0, MOST_PSF_PX),
    "flicker": ("a depth from 0 to 1", 0, 1),
    "flicker_hz": ("Hz from 1 to 100000", 1, 1e5),
    "flicker_duty": ("0, or a share below 1", 0, 0.999),
    "warming_k": ("kelvin from -50 to 50", -50, 50),
    "reset_noise": (f"thresholds from 0 to {_MOST_NOISE}", 0, _MOST_NOISE),
    "read_noise": (f"thresholds from 0 to {_MOST_NOISE}", 0, _MOST_NOISE),
    "dead_ticks": (f"ticks from 0 to {MOST_DEAD_TICKS}", 0, MOST_DEAD_TICKS),
    "clock_ripple": (f"thresholds from 0 to {_MOST_NOISE}", 0, _MOST_NOISE),
    "light": ("a share from 1/1024 to 16", 1 / 1024, 16),
    "lost_ticks": ("a share from 0 to 0.5", 0, 0.5),
    "speed": ("a factor from 1/64 to 16", 1 / 64, 16),
    "array_motion": ("metres per second from 0 to 100", 0, 100),
    "array_rotation": ("degrees per second from 0 to 1000", 0, 1000),
}


def _check(physics: Physics) -> None:
    for name, (expected, least, most) in _RANGES.items():
        value = getattr(physics, name)
        if not least <= value <= most:
            raise problem(f"--{name.replace('_', '-')}", expected, f"{value:g}", "correct it")


def from_settings(settings: Mapping[str, Any]) -> Physics:
    """Return the physics of `Physics.settings`."""
    values: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in {**settings}.items()}
    return Physics(**values)


def true_cameras(cameras: Sequence[Camera], views: Sequence[int], physics: Physics, seed: int) -> tuple[Camera, ...]:
    """Return the rig's ideal cameras with their lenses and principal points: a function of `seed` and view alone."""
    return tuple(_true_camera(c, view, physics, seed) for c, view in zip(cameras, views, strict=True))


def _true_camera(camera: Camera, view: int, physics: Physics, seed: int) -> Camera:
    share = np.random.default_rng([seed, view, *b"lens"]).uniform(-1, 1) * physics.lens_spread
    camera = replace(camera, distortion=tuple(k * (1 + float(share)) for k in physics.lens))
    if not physics.principal_point:
        return camera
    x, y = np.random.default_rng([seed, view, *b"principal point"]).normal(size=2) * physics.principal_point
    return replace(camera, cx=camera.cx + float(x) * camera.width, cy=camera.cy + float(y) * camera.width)


def given_cameras(
    cameras: Sequence[Camera], exact: str, physics: Physics, entropy: Sequence[int]
) -> tuple[Camera, ...]:
    """Return the cameras with the poses that methods are given: turned about their centres, and moved.

    Camera `exact` keeps its pose. `entropy`: of the random numbers, which differ by camera.
    """
    if not physics.moves_poses:
        return tuple(cameras)
    return tuple(c if c.id == exact else _moved(c, physics, entropy) for c in cameras)


def _moved(camera: Camera, physics: Physics, entropy: Sequence[int]) -> Camera:
    turn, shift = np.random.default_rng([*entropy, *f"{camera.id} pose".encode()]).normal(size=(2, 3))
    R = Rotation.from_rotvec(turn * physics.pose_noise_deg, degrees=True).as_matrix() @ camera.R
    return replace(camera, R=R, t=-R @ (camera.center + shift * physics.pose_noise_m))
