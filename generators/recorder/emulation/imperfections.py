"""Imperfections of an emulated array, so that a capture can be made worse on purpose: sizes, and what a seed draws.

`retiming` applies clocks, gains and bad pixels to streams; dropped ticks are faults of the emulated cameras.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.camera_state import Clock
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.lens import make_distortion
from spike4dgs.generators.recorder.emulation.camera import LOST, Fault
from spike4dgs.generators.recorder.frames.layouts import make_layout
from spike4dgs.generators.recorder.rig_profile import PRIMARY, RigProfile

Pixels = NDArray[np.int64]  # [n], row * width + column, row 0 at the top


@dataclass(frozen=True)
class Imperfections:
    """Faults that an emulated capture gets on purpose. --seed decides what each camera gets.

    Attributes:
        offset_ticks: Largest offset of a camera's clock; the primary camera's is exact.
        drift_ppm: Largest drift of a camera's clock, in parts per million; the primary camera's is exact.
        dropped: Share of the clip's ticks that are lost, one by one, on the way; the recorder sees gaps.
        bad_pixels: Number of bad pixels of each camera: a third each are dead, hot and flickering.
        gain: Largest relative difference of a camera's gain from the array's; 0.02 is 2 percent.
        pose_deg: Rotation between a camera's written and true pose, in degrees.
        lens: Share of the lens distortion that each camera's written calibration lacks; 1 writes a pinhole.
    """

    offset_ticks: float = 0.0
    drift_ppm: float = 0.0
    dropped: float = 0.0
    bad_pixels: int = 0
    gain: float = 0.0
    pose_deg: float = 0.0
    lens: float = 0.0


PERFECT = Imperfections()
_MOST = {
    "offset_ticks": 1e4,
    "drift_ppm": 1e4,
    "dropped": 0.5,
    "bad_pixels": 1e6,
    "gain": 0.5,
    "pose_deg": 90.0,
    "lens": 1.0,
}


@dataclass(frozen=True, eq=False)
class BadPixels:
    """The bad pixels of one camera. `current` is charge per tick that a hot pixel always gets, a flickering one at
    times."""

    dead: Pixels
    hot: Pixels
    flickering: Pixels
    current: Float64  # [hot, then flickering]


@dataclass(frozen=True, eq=False)
class WorseCamera:
    """The imperfections of one camera."""

    clock: Clock
    gain: float
    bad: BadPixels
    turn: Float64  # [3, 3], from the true to the written camera axes
    dropped: tuple[int, ...]  # ticks
    known_lens: float = 1.0  # share of the lens distortion that the written calibration has


def check(worse: Imperfections) -> None:
    """Raise UserError for a size that no array has."""
    for name, most in _MOST.items():
        value = getattr(worse, name)
        if not 0 <= value <= most:
            option = f"--worse.{name.replace('_', '-')}"
            raise problem(option, f"a number from 0 to {most:g}", f"{value:g}", "correct it")


def draw(worse: Imperfections, profile: RigProfile, n_ticks: int, seed: int) -> dict[str, WorseCamera]:
    """Return the imperfections of each camera, a function of the seed and the camera's name.

    Raises UserError where ticks are to be dropped that the profile's layout would not miss.
    """
    check(worse)
    layout = make_layout(profile.layout, profile.width, profile.height)
    if worse.dropped and not layout.count_tags:
        fix = "use such a layout, or leave out --worse.dropped"
        raise problem(f"rig {profile.name}", "frames with a counter, for losses to be seen", layout.name, fix)
    if worse.bad_pixels > profile.width * profile.height:
        raise problem("--worse.bad-pixels", f"at most {profile.width * profile.height}", f"{worse.bad_pixels}", "fewer")
    return {c.id: _draw(worse, profile, c.id, c.role == PRIMARY, n_ticks, seed) for c in profile.cameras}


def _draw(worse: Imperfections, rig: RigProfile, camera: str, exact: bool, n_ticks: int, seed: int) -> WorseCamera:
    offset, drift, gain = random(seed, camera, "clock and gain").uniform(-1, 1, 3)
    clock = Clock() if exact else Clock(float(offset * worse.offset_ticks), float(drift * worse.drift_ppm))
    lost = random(seed, camera, "dropped").random(n_ticks) < worse.dropped
    lost[:1] = False  # the cameras agree on the first tick that all of them have
    return WorseCamera(
        clock=clock,
        gain=1 + float(gain) * worse.gain,
        bad=_bad_pixels(worse.bad_pixels, rig.width * rig.height, random(seed, camera, "bad pixels")),
        turn=_turn(worse.pose_deg, random(seed, camera, "pose")),
        dropped=tuple(np.nonzero(lost)[0].tolist()),
        known_lens=1 - worse.lens,
    )


def _bad_pixels(count: int, pixels: int, rng: np.random.Generator) -> BadPixels:
    chosen = rng.choice(pixels, count, replace=False).astype(np.int64)
    dead, hot, flickering = (np.sort(chosen[i::3]) for i in range(3))
    return BadPixels(dead, hot, flickering, rng.uniform(0.1, 0.9, len(hot) + len(flickering)))


def _turn(degrees: float, rng: np.random.Generator) -> Float64:
    axis = rng.normal(size=3)
    return np.asarray(cv2.Rodrigues(np.deg2rad(degrees) * axis / np.linalg.norm(axis))[0], np.float64)


def random(seed: int, camera: str, what: str) -> np.random.Generator:
    """Return the generator of one thing that a seed decides for a camera."""
    return np.random.default_rng([seed, *f"{camera} {what}".encode()])


def dropped_ticks(cameras: Mapping[str, WorseCamera], profile: RigProfile) -> list[Fault]:
    """Return the loss of each dropped tick."""
    size = make_layout(profile.layout, profile.width, profile.height).frame_bytes
    return [Fault(name, LOST, tick, lost=size) for name, camera in cameras.items() for tick in camera.dropped]


def with_wrong_calibrations(profile: RigProfile, cameras: Mapping[str, WorseCamera]) -> RigProfile:
    """Return the profile with each calibration turned about the camera's centre, and without a share of its lens."""

    def wrong(camera: Camera, to: WorseCamera) -> Camera:
        R = to.turn @ camera.R
        lens = make_distortion([k * to.known_lens for k in camera.distortion])
        return replace(camera, R=R, t=-R @ camera.center, distortion=lens)

    return replace(
        profile,
        cameras=tuple(
            replace(c, calibration=c.calibration and wrong(c.calibration, cameras[c.id])) for c in profile.cameras
        ),
    )


def truth_record(worse: Imperfections, seed: int, cameras: Mapping[str, WorseCamera], width: int) -> dict[str, Any]:
    """Return what was done to each camera, for a file that reports compare with. Pixels are [row, column]."""

    def places(pixels: Pixels) -> Sequence[Sequence[int]]:
        return [[int(p) // width, int(p) % width] for p in pixels]

    return {
        "seed": seed,
        "worse": asdict(worse),
        "cameras": {
            name: {
                **asdict(c.clock),
                "gain": c.gain,
                "dead": places(c.bad.dead),
                "hot": places(c.bad.hot),
                "flickering": places(c.bad.flickering),
                "dropped_ticks": list(c.dropped),
                "turn": c.turn.tolist(),
            }
            for name, c in cameras.items()
        },
    }
